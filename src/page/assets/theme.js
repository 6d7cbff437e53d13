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
  // Times in pictures: the ticks of an axis, and times within the text at a point.
  const styles = { date: { dateStyle: "short" }, day: { month: "2-digit", day: "2-digit" }, hour: { month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit" }, minute: { hour: "2-digit", minute: "2-digit" } };
  for (const tick of within.querySelectorAll("text[data-time]")) {
    const at = new Date(tick.dataset.time);
    if (!Number.isNaN(at.getTime())) tick.textContent = at.toLocaleString(document.documentElement.lang, styles[tick.dataset.style] || styles.hour);
  }
  for (const title of within.querySelectorAll("svg.chart title")) {
    title.textContent = title.textContent.replace(/(\d{4}-\d\d-\d\d) (\d\d:\d\d:\d\d) UTC/, (utc, day, time) => {
      const at = new Date(`${day}T${time}Z`);
      return Number.isNaN(at.getTime()) ? utc : at.toLocaleString(document.documentElement.lang, { dateStyle: "medium", timeStyle: "medium" });
    });
  }
  for (const zone of within.querySelectorAll("[data-zone]")) zone.textContent = zone.dataset.zone;
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
