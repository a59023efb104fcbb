// Enhancements of the pages: follows a queued submission and shows the progress of an upload. Without this script,
// the page of a queued submission reloads periodically, and the form is submitted by the browser.
(() => {
  "use strict";
  const POLL_MS = 2000;

  const inPage = (html, id) => new DOMParser().parseFromString(html, "text/html").getElementById(id);

  // Show the state of a waiting submission as it changes, and load its page again when it waits no longer.
  async function follow(state) {
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    const page = await fetch(location.href).then((answer) => answer.text()).catch(() => "");
    const fresh = inPage(page, "state");
    if (fresh && !("waits" in fresh.dataset)) return location.reload();
    if (fresh && fresh.textContent !== state.textContent) state.replaceChildren(...fresh.childNodes);
    return follow(state);
  }

  const megabytes = (bytes) => `${(bytes / 1e6).toFixed(1)} MB`;

  function upload(form) {
    const [bar, said, spoken] = ["progress", ".said", ".spoken"].map((what) => form.querySelector(what));
    const [box, button] = [form.querySelector(".progress"), form.querySelector("button")];
    let tenth = -1;

    function tell(text, aloud) {
      said.textContent = text;
      if (aloud) spoken.textContent = text;
    }

    function ended(text) {
      button.disabled = false;
      bar.hidden = true;
      tell(text, true);
    }

    function refused(page) {
      const fresh = inPage(page, "refusal");
      if (!fresh) return ended("The service returned an unexpected response. Please try again.");
      document.getElementById("refusal")?.remove();
      document.querySelector("h1").after(fresh);
      ended("Not accepted: see above.");
      return fresh.focus();
    }

    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const file = form.elements.archive.files[0];
      box.hidden = bar.hidden = false;
      if (file.size > Number(form.dataset.most)) return ended("The archive is larger than the upload limit.");
      button.disabled = true;
      const request = new XMLHttpRequest();
      request.upload.addEventListener("progress", ({ loaded, total }) => {
        bar.value = loaded / total;
        const now = Math.floor((10 * loaded) / total);
        tell(`${megabytes(loaded)} of ${megabytes(total)}`, now !== tenth);
        tenth = now;
      });
      request.upload.addEventListener("load", () => {
        bar.removeAttribute("value");
        tell("Uploaded. The archive is being checked …", true);
      });
      request.addEventListener("load", () => {
        if (request.status < 400) location.assign(request.responseURL);
        else refused(request.responseText);
      });
      request.addEventListener("error", () => ended("The connection was lost. Please try again."));
      request.open("POST", form.action);
      request.setRequestHeader("Accept", "text/html");
      return request.send(new FormData(form));
    });
  }

  const state = document.querySelector("[data-waits]");
  if (state) follow(state);
  const form = document.getElementById("upload-form");
  if (form) upload(form);
})();
