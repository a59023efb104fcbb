// Shows the articles of section.browser one at a time: buttons, left and right arrow keys, thumbnails, a choice of
// config. Without this script all articles stand below each other; on paper they always do.
(() => {
  "use strict";
  const section = document.querySelector("section.browser");
  if (!section) return;
  const articles = Array.from(section.querySelectorAll("article"));
  const [controls, strip, choice, status] = [".controls", ".thumbs", "select", "output"].map((what) => section.querySelector(what));
  const [back, on] = section.querySelectorAll("button[data-step]");
  const chosen = () => articles.filter((one) => !choice || !choice.value || one.dataset.config === choice.value);
  let current = articles[0];

  const thumbs = articles.map((article) => {
    const button = document.createElement("button");
    const image = document.createElement("img");
    image.src = article.querySelector(".panels img").src;
    image.alt = "";
    button.type = "button";
    button.append(image, article.dataset.label);
    button.addEventListener("click", () => show(article));
    return button;
  });

  function show(article) {
    const among = chosen();
    const at = among.indexOf(article);
    current = article;
    articles.forEach((one, index) => {
      one.classList.toggle("shown", one === article);
      thumbs[index].hidden = !among.includes(one);
      thumbs[index].setAttribute("aria-current", String(one === article));
    });
    back.disabled = at === 0;
    on.disabled = at === among.length - 1;
    status.textContent = `${at + 1} of ${among.length}`;
    const thumb = thumbs[articles.indexOf(article)];
    strip.scrollLeft = thumb.offsetLeft - (strip.clientWidth - thumb.offsetWidth) / 2;
  }

  function step(by) {
    const among = chosen();
    const next = among[among.indexOf(current) + by];
    if (next) show(next);
  }

  function inView() {
    const box = section.getBoundingClientRect();
    return box.top < innerHeight / 2 && box.bottom > innerHeight / 4;
  }

  for (const button of [back, on]) button.addEventListener("click", () => step(Number(button.dataset.step)));
  if (choice) choice.addEventListener("change", () => show(chosen()[0]));
  document.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const free = event.target === document.body ? inView() : section.contains(event.target) && event.target !== choice;
    if (!by || !free || event.altKey || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    step(by);
  });
  strip.append(...thumbs);
  controls.hidden = false;
  section.classList.add("browsing");
  show(current);
})();
