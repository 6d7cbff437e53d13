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
    const limit = regrindMap.roundLimit(Math.max(...grids.map((grid) => (grid ? regrindMap.statistics(grid.values).limit : 0))) || 1);
    const frame = regrindMap.frameOf(grids.filter(Boolean));
    const both = grids.every(Boolean) ? regrindMap.difference(grids[1], grids[0]) : null;
    const own = both ? regrindMap.roundLimit(regrindMap.statistics(both.values).limit) : 1;
    const paint = () => {
      document.querySelectorAll(".compare section").forEach((section, k) => {
        regrindMap.draw(section.querySelector("canvas"), { grid: grids[k], limit, colours, frame, missing: texts.notMeasured, most: Math.max(240, 0.48 * innerHeight) });
      });
      regrindMap.draw(element("difference"), { grid: both, limit: own, colours, frame, missing: texts.notMeasured, most: Math.max(240, 0.48 * innerHeight) });
    };
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
    regrindTimes(holder);
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

  const [canvas, relief, reading, caption, cycles, scales] = ["map", "relief", "reading", "caption", "cycle", "scale"].map(element);
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
  scales.addEventListener("change", update);
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

  /** The difference of a cycle has a scale of its own: nothing else is comparable with it. */
  async function limitOf(grid, mapped) {
    const own = regrindMap.roundLimit(regrindMap.statistics(grid.values).limit);
    if (view === "sigma" || view === "difference" || scales.value === "own") return own;
    if (scales.value === "tolerance") return state.toleranceUm ? state.toleranceUm / 2 : own;
    const first = await mapOf(run, mapped[0].cycle, mapped[0].map);
    return first ? regrindMap.roundLimit(regrindMap.statistics(first.values).limit) : own;
  }

  async function make() {
    const mapped = state.cycles.filter((of) => of.map);
    const at = mapped.findIndex((of) => String(of.cycle) === cycles.value);
    let grid = at < 0 ? null : await mapOf(run, mapped[at].cycle, mapped[at].map);
    let missing = texts.notMeasured;
    if (grid && view === "difference") {
      const before = at > 0 ? await mapOf(run, mapped[at - 1].cycle, mapped[at - 1].map) : null;
      grid = before && regrindMap.difference(grid, before);
      missing = texts.noCycleBefore;
    }
    if (grid && view === "sigma") grid = { ...grid, values: grid.sigma, low: 0 };
    const limit = grid ? await limitOf(grid, mapped) : 1;
    return { grid, limit, missing, ...await dotsOver(grid, limit, at < 0 ? null : mapped[at]) };
  }

  /** The points of the plan until there is a map, or those of the cycle where somebody wants them. */
  async function dotsOver(grid, limit, of) {
    if (view !== "relief" && view !== "difference" && (state.touched || !grid) && (!grid || withPoints)) {
      const plan = await dotsOfPlan(Boolean(grid));
      if (plan) return plan;
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

  /** The points of the plan: full where they were touched. */
  async function dotsOfPlan(isOverMap) {
    planned = planned || await bytes(`${base}/planned`);
    if (!planned) return null;
    const places = new Float32Array(planned);
    const count = places.length / 2;
    const [done, total] = state.touched || [0, count];
    // Where touches are chosen, a job has fewer points than the plan, in an order of its own. They are drawn once they are known.
    const isChosen = total < count;
    if (isChosen && isOverMap) return null;
    // The reference sphere is touched before the part.
    const touched = isChosen ? 0 : Math.max(0, done - (total - count));
    const ink = getComputedStyle(document.body).color.match(/\d+/g).slice(0, 3).map(Number);
    const dots = [];
    for (let k = 0; k < count; k += 1) {
      const isTouched = k < touched;
      dots.push({ at: [places[2 * k], places[2 * k + 1]], size: isTouched ? 2.6 : 1.4, rgb: isTouched ? ink : null });
    }
    const key = isChosen
      ? `○ ${texts.planned} ${number(count, 0)}   ${texts.touched} ${number(done, 0)} / ${number(total, 0)}`
      : `● ${texts.touched} ${number(touched, 0)}   ○ ${texts.planned} ${number(count - touched, 0)}`;
    return { dots, key };
  }

  let seen = null;
  function paint() {
    if (!current) return;
    const { grid, limit, dots, missing } = current;
    const hues = grid && grid.low === 0 ? unsigned : colours;
    const asRelief = view === "relief" && grid;
    if (asRelief && solid === undefined) solid = regrindRelief.prepare(relief);
    const drawnSolid = asRelief && solid;
    [canvas.hidden, relief.hidden] = [Boolean(drawnSolid), !drawnSolid];
    if (drawnSolid) solid.show(grid, limit, colours);
    else seen = regrindMap.draw(canvas, { grid, limit, colours: hues, dots, mark, missing, most: Math.max(280, innerHeight - 400) });
    element("histogram").hidden = !grid;
    if (grid) regrindMap.histogram(element("histogram"), grid, limit, hues);
    read(asRelief && !solid ? texts.noRelief : null);
  }

  /** A number in the language of the page. */
  const number = (value, digits) => value.toLocaleString(document.documentElement.lang, { minimumFractionDigits: digits, maximumFractionDigits: digits });

  /** Says what the map is, and what it has at the mark, or in all. */
  function read(instead) {
    const { grid, key } = current;
    caption.textContent = grid
      ? [`${number(grid.columns * grid.stepX, 0)} × ${number(grid.rows * grid.stepY, 0)} mm`, ...(grid.low < 0 ? [texts.sign] : [])].join(" · ")
      : key || "";
    if (instead || !grid) {
      reading.textContent = instead || "";
      return;
    }
    const { pv, rms } = regrindMap.statistics(grid.values);
    const whole = grid.low === 0
      ? `${texts.known} ${number(rms, 3)} µm`
      : `${texts.filtered} PV ${number(pv, 2)} µm, RMS ${number(rms, 3)} µm`;
    if (!mark) {
      reading.textContent = whole;
      return;
    }
    const [column, row] = [(mark[0] - grid.firstX) / grid.stepX, (mark[1] - grid.firstY) / grid.stepY].map(Math.round);
    const inside = column >= 0 && row >= 0 && column < grid.columns && row < grid.rows;
    const node = row * grid.columns + column;
    const value = inside ? grid.values[node] : NaN;
    const sign = grid.low === 0 ? "" : value >= 0 ? "+" : "−";
    const known = grid.low === 0 ? "" : ` ± ${number(2 * grid.sigma[node], 2)}`;
    const words = Number.isNaN(value) ? "–" : `${sign}${number(Math.abs(value), 2)}${known} µm`;
    reading.textContent = `x ${number(mark[0], 2)} mm, y ${number(mark[1], 2)} mm: ${words}`;
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
