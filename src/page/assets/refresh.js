// A view that shows what changes is fetched again while somebody looks at it. The settings of this browser.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
  const main = document.querySelector("main");
  const interval = Number(main.dataset.refreshMs);
  const again = async () => {
    const answer = document.hidden ? null : await fetch(location.href).catch(() => null);
    if (!document.hidden) document.body.classList.toggle("old", !answer || !answer.ok);
    const text = answer && answer.ok ? await answer.text() : "";
    const next = text && new DOMParser().parseFromString(text, "text/html").querySelector("main.machines");
    if (next) {
      main.replaceChildren(...next.childNodes);
      regrindTimes(main);
    }
    // The program of the run no longer answers: nothing changes any more.
    if (!next || next.dataset.refreshMs) setTimeout(again, interval);
  };
  if (interval) setTimeout(again, interval);
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
