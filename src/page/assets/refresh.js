// A view that shows what changes is fetched again while somebody looks at it. The settings of this browser.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
  const main = document.querySelector("main");
  const interval = Number(main.dataset.refreshMs);
  if (interval) {
    setInterval(async () => {
      if (document.hidden) return;
      const answer = await fetch(location.href).catch(() => null);
      if (!answer || !answer.ok) return document.body.classList.add("old");
      const next = new DOMParser().parseFromString(await answer.text(), "text/html").querySelector("main");
      if (!next || !next.className.includes("machines")) return;
      document.body.classList.remove("old");
      main.replaceChildren(...next.childNodes);
      regrindTimes(main);
    }, interval);
  }
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
