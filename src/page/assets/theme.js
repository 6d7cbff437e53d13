// What must be known before the first line is painted: a page that turns dark after a moment hurts at night.
"use strict";
(() => {
  const theme = localStorage.getItem("regrind-theme");
  if (theme) document.documentElement.dataset.theme = theme;
  document.addEventListener("DOMContentLoaded", () => {
    const [themes, languages] = ["theme", "language"].map((id) => document.getElementById(id));
    themes.value = theme || "";
    themes.addEventListener("change", () => {
      localStorage.setItem("regrind-theme", themes.value);
      if (themes.value) document.documentElement.dataset.theme = themes.value;
      else delete document.documentElement.dataset.theme;
      document.dispatchEvent(new Event("regrind-theme"));
    });
    if (languages) languages.addEventListener("change", () => {
      document.cookie = `regrind_language=${languages.value}; SameSite=Strict; Path=/; Max-Age=31536000`;
      location.reload();
    });
  });
})();
