// A view that shows what changes is fetched again while somebody looks at it. The settings of this browser.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
  const main = document.querySelector("main");
  const intervalOf = (page) => Number(page.querySelector("[data-refresh-ms]")?.dataset.refreshMs || 0);
  const lost = document.getElementById("lost");
  /** Puts the content of `next` in the place of the present one. An open detail stays open, and what is scrolled stays there. */
  const replace = (next) => {
    const [open, scrolled] = [new Set(), [...main.querySelectorAll(".wide")].map((of) => of.scrollLeft)];
    for (const of of main.querySelectorAll("details[id][open]")) open.add(of.id);
    const focused = document.activeElement && document.activeElement.id;
    main.replaceChildren(...next.childNodes);
    for (const of of main.querySelectorAll("details[id]")) of.open = of.open || open.has(of.id);
    main.querySelectorAll(".wide").forEach((of, k) => { of.scrollLeft = scrolled[k] ?? of.scrollLeft; });
    if (focused && document.activeElement === document.body) document.getElementById(focused)?.focus({ preventScroll: true });
    regrindTimes(main);
  };
  const again = async () => {
    const answer = document.hidden ? null : await fetch(location.href).catch(() => null);
    // A page that says why it has no data is an answer too.
    const isPage = answer && (answer.ok || answer.status === 503);
    if (!document.hidden) {
      document.body.classList.toggle("old", !isPage);
      if (lost) lost.hidden = Boolean(isPage);
    }
    const page = isPage && new DOMParser().parseFromString(await answer.text(), "text/html");
    const next = page && page.querySelector("main");
    if (next && next.className === main.className) replace(next);
    // The program of the run no longer answers: nothing changes any more.
    const interval = next ? intervalOf(page) : intervalOf(document);
    if (interval) setTimeout(again, interval);
  };
  if (intervalOf(document)) setTimeout(again, intervalOf(document));
  const [themes, languages] = ["theme", "language"].map((id) => document.getElementById(id));
  const showTheme = () => document.querySelectorAll("[data-theme-choice]").forEach((button) => {
    button.setAttribute("aria-pressed", String(button.dataset.themeChoice === themes.value));
  });
  const choose = (select, value) => {
    select.value = value;
    select.dispatchEvent(new Event("change"));
  };
  document.querySelectorAll("[data-theme-choice]").forEach((button) => button.addEventListener("click", () => {
    choose(themes, button.dataset.themeChoice);
    showTheme();
  }));
  document.querySelectorAll("[data-language]").forEach((button) => button.addEventListener("click", () => choose(languages, button.dataset.language)));
  showTheme();
});
