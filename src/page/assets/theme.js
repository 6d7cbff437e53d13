// What must be known before the first line is painted: a page that turns dark after a moment hurts at night.
"use strict";
/** Shows the times within an element in the time zone and the language of the reader. */
function regrindTimes(within) {
  for (const time of within.querySelectorAll("time[datetime]")) {
    const at = new Date(time.dateTime);
    if (Number.isNaN(at.getTime())) continue;
    time.title = time.title || time.textContent;
    time.textContent = at.toLocaleString(document.documentElement.lang, { dateStyle: "medium", timeStyle: "medium" });
  }
}
(() => {
  const theme = localStorage.getItem("regrind-theme");
  if (theme) document.documentElement.dataset.theme = theme;
  document.addEventListener("DOMContentLoaded", () => {
    regrindTimes(document);
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
