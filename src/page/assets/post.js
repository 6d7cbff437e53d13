// What changes something is sent with a token that is fetched for it and is good once.
"use strict";
const regrindPost = async (url, body) => {
  const given = await fetch("/token");
  if (!given.ok) {
    // Whoever sat here is signed out, or the page was begun anew: it shows how to come in again.
    location.reload();
    throw new Error("not let in");
  }
  const headers = { "X-Regrind-Token": await given.text(), "Content-Type": "application/json" };
  return fetch(url, { method: "POST", headers, body });
};
document.addEventListener("DOMContentLoaded", () => {
  const remark = document.getElementById("remark");
  if (remark) remark.addEventListener("submit", async (event) => {
    event.preventDefault();
    const run = document.querySelector("main[data-run]").dataset.run;
    const body = JSON.stringify({ order: "remark", what: remark.elements.what.value });
    const said = document.getElementById("remarked");
    try {
      const answer = await (await regrindPost(`/runs/${encodeURIComponent(run)}/orders`, body)).json();
      if (answer.accepted) return location.reload();
      said.textContent = answer.message;
    } catch (error) {
      said.textContent = String(error.message || error);
    }
  });
  const out = document.getElementById("sign-out");
  if (out) out.addEventListener("click", () => regrindPost("/sign-out", "").then(() => location.assign("/"), () => {}));
});
