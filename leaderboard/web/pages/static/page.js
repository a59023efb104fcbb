// Enhancements of the pages: polls the status of a queued submission and shows the progress of an upload. Without
// this script, the page of a queued submission reloads periodically, and the form is submitted by the browser.
(() => {
  "use strict";
  const POLL_MS = 2000;

  // Poll the status of a submission, update its queue position, and reload the page when it is scored or failed.
  function follow(state) {
    const again = () => setTimeout(() => ask().catch(again), POLL_MS);
    async function ask() {
      const answer = await fetch(state.dataset.poll, { headers: { Accept: "application/json" } });
      if (!answer.ok) return again();
      const { status } = await answer.json();
      if (status !== "queued" && status !== "scoring") return location.reload();
      if (status === "queued" || status !== state.dataset.status) await refresh(state);
      state.dataset.status = status;
      again();
    }
    again();
  }

  async function refresh(state) {
    const page = await (await fetch(location.href)).text();
    const fresh = new DOMParser().parseFromString(page, "text/html").getElementById("state");
    if (fresh && fresh.textContent !== state.textContent) state.replaceChildren(...fresh.childNodes);
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
      const fresh = new DOMParser().parseFromString(page, "text/html").getElementById("refusal");
      if (!fresh) return ended("The service returned an unexpected response. Please try again.");
      document.getElementById("refusal")?.remove();
      document.querySelector("h1").after(fresh);
      ended("Not accepted: see above.");
      fresh.focus();
      return undefined;
    }

    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const file = form.elements.archive.files[0];
      box.hidden = false;
      bar.hidden = false;
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
      request.send(new FormData(form));
      return undefined;
    });
  }

  const state = document.querySelector("[data-poll]");
  if (state) follow(state);
  const form = document.getElementById("upload-form");
  if (form) upload(form);
})();
