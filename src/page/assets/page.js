// What moves on the page: the pieces that the server sends anew, the orders, the maps.
"use strict";
(() => {
  const element = (id) => document.getElementById(id);
  const data = JSON.parse(element("data").textContent);
  const [colours, unsigned] = [data.colours, data.unsigned || ""].map(regrindMap.readColours);
  const texts = data.texts;

  /** Fetches bytes once; those of a map never change under one name. */
  const fetched = new Map();
  function bytes(url) {
    if (!fetched.has(url)) {
      const answer = fetch(url).then((response) => (response.ok ? response.arrayBuffer() : null));
      fetched.set(url, answer.catch(() => { fetched.delete(url); return null; }));
    }
    return fetched.get(url);
  }
  const mapOf = async (run, cycle, name) => {
    const buffer = await bytes(`/runs/${encodeURIComponent(run)}/cycles/${cycle}/map?of=${encodeURIComponent(name || "")}`);
    return buffer && regrindMap.readGrid(buffer);
  };

  if (data.compared) {
    compare();
    return;
  }

  async function compare() {
    const grids = await Promise.all(data.compared.map(({ run, cycle }) => (cycle ? mapOf(run, cycle) : null)));
    // One scale for both: else the worse looks like the better.
    const limit = Math.max(...grids.map((grid) => (grid ? regrindMap.statistics(grid.values).limit : 0))) || 1;
    const paint = () => document.querySelectorAll(".compare section").forEach((section, k) => {
      regrindMap.draw(section.querySelector("canvas"), { grid: grids[k], limit, colours });
    });
    paint();
    addEventListener("resize", paint);
    document.addEventListener("regrind-theme", paint);
  }

  // ---- what the server sends ----

  const run = data.run;
  const base = `/runs/${encodeURIComponent(run)}`;
  let state = data.state;
  let heard = Date.now();
  /** When the program of the run was heard last: by this page, or else by its record. */
  let programHeard = Date.parse(state.last) || 0;

  const source = new EventSource(`${base}/events`);
  source.addEventListener("message", (message) => {
    const { pieces, state: now } = JSON.parse(message.data);
    for (const [id, html] of Object.entries(pieces)) replace(element(id), html);
    const before = state;
    [state, heard] = [now, Date.now()];
    programHeard = state.lost ? Math.max(programHeard, Date.parse(state.last) || 0) : heard;
    shown(before);
  });

  /** Puts new HTML in, and leaves the focus and what somebody has typed where they were. */
  function replace(holder, html) {
    const focused = holder.contains(document.activeElement) ? document.activeElement.dataset.order || document.activeElement.id : null;
    const typed = element("evidence") && holder.contains(element("evidence")) ? element("evidence").value : null;
    const chosen = element("result-file") && holder.contains(element("result-file")) ? element("result-file") : null;
    holder.innerHTML = html;
    if (chosen && element("result-file")) element("result-file").replaceWith(chosen);
    if (typed !== null && element("evidence")) element("evidence").value = typed;
    if (focused) (holder.querySelector(`[data-order="${focused}"]`) || element(focused) || holder).focus?.();
  }

  function shown(before) {
    for (const button of document.querySelectorAll("[data-order]")) {
      const order = button.dataset.order;
      button.disabled = order !== "control" && !state.can.includes(order);
    }
    tellAge();
    const names = (of) => JSON.stringify(of.cycles);
    if (names(before) !== names(state) || (before.touched || []).join() !== (state.touched || []).join()) chooseCycle();
  }

  /** Says that what is shown is old, as soon as it is, and since when. */
  function tellAge() {
    const serverGone = Date.now() - heard > 2500;
    const old = (serverGone && !state.over) || state.lost;
    document.body.classList.toggle("old", old);
    const words = element("old");
    words.hidden = !old;
    if (old) {
      const last = new Date(state.lost ? programHeard : heard);
      const isToday = last.toDateString() === new Date().toDateString();
      const since = isToday ? last.toLocaleTimeString() : last.toLocaleString();
      const told = last.getTime() ? `${texts.noData} ${since}. ` : "";
      const programGone = state.machinesWithin ? texts.simulationGone : texts.programGone;
      const text = told + (serverGone ? texts.pageGone : programGone);
      if (words.textContent !== text) words.textContent = text;
    }
  }
  setInterval(tellAge, 500);

  // ---- orders ----

  const bodies = {
    hold: () => ({ order: "hold", reason: "" }),
    resume: () => ({ order: "resume", reason: "", seen: state.number }),
    stop: () => ({ order: "stop", reason: "" }),
    abort: () => ({ order: "abort", reason: "" }),
    loaded: () => ({ order: "loaded" }),
    clear: (button) => ({ order: "clear", device: button.dataset.device }),
    started: (button) => ({ order: "started", map: button.dataset.map || null }),
    done: (button) => ({ order: "done", map: button.dataset.map || null }),
    still: (button) => ({ order: "still", device: button.dataset.device }),
    over: (button) => ({ order: "over", device: button.dataset.device, evidence: element("evidence").value.trim() }),
  };

  document.addEventListener("click", async (event) => {
    const button = event.target.closest("[data-order]");
    if (!button || button.disabled) return;
    const order = button.dataset.order;
    if (order === "over" && !element("evidence").value.trim()) {
      element("evidence").focus();
      return;
    }
    const file = order === "measurement" ? element("result-file").files[0] : null;
    if (order === "measurement" && !file) {
      element("result-file").focus();
      return;
    }
    const urls = { control: `${base}/control`, measurement: file && `${base}/measurement?name=${encodeURIComponent(file.name)}` };
    const url = urls[order] || `${base}/orders`;
    const body = file || (order === "control" ? "" : JSON.stringify(bodies[order](button)));
    try {
      const answer = await regrindPost(url, body);
      const { accepted, message } = await answer.json();
      answered(accepted, `${button.textContent.trim()}: ${message}`);
    } catch (error) {
      answered(false, `${button.textContent.trim()}: ${texts.pageGone}`);
    }
  });

  /** What was taken is shown for as long as it is news; what was refused until something else is. */
  let forgetting;
  function answered(accepted, words) {
    const answer = element("answer");
    clearTimeout(forgetting);
    if (accepted) forgetting = setTimeout(() => { answer.textContent = texts.order; }, 8000);
    answer.textContent = words;
    answer.classList.toggle("no", !accepted);
  }

  // ---- the map ----

  const [canvas, relief, reading, cycles] = ["map", "relief", "reading", "cycle"].map(element);
  let view = "map";
  let withPoints = false;
  let chosen = null;
  let current = null;
  let mark = null;
  let planned = null;
  let solid;

  document.querySelectorAll("[data-view]").forEach((button) => button.addEventListener("click", () => {
    view = button.dataset.view;
    document.querySelectorAll("[data-view]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
    update();
  }));
  document.querySelector("[data-points]").addEventListener("click", (event) => {
    withPoints = !withPoints;
    event.currentTarget.setAttribute("aria-pressed", String(withPoints));
    update();
  });
  cycles.addEventListener("change", () => {
    chosen = cycles.value === "" ? null : Number(cycles.value);
    update();
  });

  /** Lists the cycles that have a map; the last one is shown unless somebody chose another. */
  function chooseCycle() {
    const mapped = state.cycles.filter((of) => of.map);
    const wanted = mapped.map((of) => String(of.cycle));
    if ([...cycles.options].map((option) => option.value).join() !== wanted.join()) {
      cycles.replaceChildren(...wanted.map((cycle) => new Option(cycle, cycle)));
    }
    const last = mapped.length ? mapped[mapped.length - 1].cycle : null;
    cycles.value = String(mapped.some((of) => of.cycle === chosen) ? chosen : last);
    cycles.disabled = !mapped.length;
    update();
  }

  let updating = 0;
  async function update() {
    const turn = (updating += 1);
    const made = await make();
    // Somebody may have chosen otherwise while the bytes were on their way.
    if (turn === updating) {
      current = made;
      paint();
    }
  }

  async function make() {
    const mapped = state.cycles.filter((of) => of.map);
    const at = mapped.findIndex((of) => String(of.cycle) === cycles.value);
    let grid = at < 0 ? null : await mapOf(run, mapped[at].cycle, mapped[at].map);
    if (grid && view === "difference") {
      const before = at > 0 ? await mapOf(run, mapped[at - 1].cycle, mapped[at - 1].map) : null;
      grid = before && regrindMap.difference(grid, before);
    }
    if (grid && view === "sigma") grid = { ...grid, values: grid.sigma, low: 0 };
    const { limit } = grid ? regrindMap.statistics(grid.values) : { limit: 1 };
    return { grid, limit, ...await dotsOver(grid, limit, at < 0 ? null : mapped[at]) };
  }

  /** The points of the plan while they are touched, or those of the cycle where somebody wants them. */
  async function dotsOver(grid, limit, of) {
    if (state.touched && view !== "relief" && (!grid || withPoints)) {
      planned = planned || await bytes(`${base}/planned`);
      const places = planned ? new Float32Array(planned) : [];
      const [[done, total], count] = [state.touched, places.length / 2];
      // Where touches are chosen a job is some of the plan, in an order of its own: what they showed is drawn once it is known.
      const isChosen = total !== count;
      if (planned && !(isChosen && grid)) {
        const ink = getComputedStyle(document.body).color.match(/\d+/g).slice(0, 3).map(Number);
        const dots = [];
        for (let k = 0; k < count; k += 1) {
          const isTouched = !isChosen && k < done;
          dots.push({ at: [places[2 * k], places[2 * k + 1]], size: isTouched ? 2.6 : 1.4, rgb: isTouched ? ink : null });
        }
        const key = isChosen
          ? `○ ${texts.planned} ${count}   ${texts.touched} ${done} / ${total}`
          : `● ${texts.touched} ${done}   ○ ${texts.planned} ${count - done}`;
        return { dots, key };
      }
    }
    if (withPoints && of && of.points) {
      const buffer = await bytes(`${base}/cycles/${of.cycle}/points?of=${encodeURIComponent(of.points)}`);
      const values = buffer ? new Float32Array(buffer) : [];
      const dots = [];
      for (let k = 0; k < values.length; k += 3) {
        const at = 3 * regrindMap.level(values[k + 2], limit);
        const hue = [colours[at], colours[at + 1], colours[at + 2]];
        // Over how well the error is known they say only where it was touched.
        const rgb = Number.isNaN(values[k + 2]) ? null : view === "sigma" ? [255, 255, 255] : hue;
        dots.push({ at: [values[k], values[k + 1]], size: 2.2, rgb });
      }
      return { dots };
    }
    return {};
  }

  let seen = null;
  function paint() {
    if (!current) return;
    const { grid, limit, dots, key } = current;
    const hues = grid && grid.low === 0 ? unsigned : colours;
    const asRelief = view === "relief" && grid;
    if (asRelief && solid === undefined) solid = regrindRelief.prepare(relief);
    const drawnSolid = asRelief && solid;
    [canvas.hidden, relief.hidden] = [Boolean(drawnSolid), !drawnSolid];
    if (drawnSolid) solid.show(grid, limit, colours);
    else seen = regrindMap.draw(canvas, { grid, limit, colours: hues, dots, mark, key });
    element("histogram").hidden = !grid;
    if (grid) regrindMap.histogram(element("histogram"), grid, limit, hues);
    read(asRelief && !solid ? texts.noRelief : null);
  }

  /** Says what the map has at the mark, or what it has in all. */
  function read(instead) {
    const grid = current && current.grid;
    if (instead || !grid) {
      reading.textContent = instead || (current && current.key ? "" : texts.notMeasured);
      return;
    }
    const { pv, rms, count } = regrindMap.statistics(grid.values);
    const whole = grid.low === 0
      ? `${texts.known} ${rms.toFixed(3)} µm`
      : `${texts.filtered} PV ${pv.toFixed(2)} µm, RMS ${rms.toFixed(3)} µm, n = ${count}`;
    if (!mark) {
      reading.textContent = whole;
      return;
    }
    const [column, row] = [(mark[0] - grid.firstX) / grid.stepX, (mark[1] - grid.firstY) / grid.stepY].map(Math.round);
    const inside = column >= 0 && row >= 0 && column < grid.columns && row < grid.rows;
    const value = inside ? grid.values[row * grid.columns + column] : NaN;
    const sign = grid.low === 0 ? "" : value >= 0 ? "+" : "−";
    const words = Number.isNaN(value) ? "–" : `${sign}${Math.abs(value).toFixed(3)} µm`;
    reading.textContent = `x ${mark[0].toFixed(2)} mm, y ${mark[1].toFixed(2)} mm: ${words}   (${whole})`;
  }

  canvas.addEventListener("pointermove", (event) => {
    if (!seen) return;
    const box = canvas.getBoundingClientRect();
    mark = seen.toPart(event.clientX - box.left, event.clientY - box.top);
    paint();
  });
  canvas.addEventListener("pointerleave", () => { mark = null; paint(); });
  canvas.addEventListener("keydown", (event) => {
    const grid = current && current.grid;
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step || !grid) return;
    event.preventDefault();
    const middle = [grid.firstX + grid.stepX * (grid.columns >> 1), grid.firstY + grid.stepY * (grid.rows >> 1)];
    mark = (mark || middle).map((place, k) => place + step[k] * (k ? grid.stepY : grid.stepX));
    paint();
  });

  addEventListener("resize", paint);
  document.addEventListener("regrind-theme", update);
  shown(state);
  chooseCycle();
})();
