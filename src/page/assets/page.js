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
    const typed = ["evidence", "hold-reason"].map(element).filter((input) => input && holder.contains(input))
      .map((input) => [input.id, input.value, input.selectionStart, input.selectionEnd]);
    const chosen = element("result-file") && holder.contains(element("result-file")) ? element("result-file") : null;
    holder.innerHTML = html;
    regrindTimes(holder);
    if (chosen && element("result-file")) element("result-file").replaceWith(chosen);
    if (focused) (holder.querySelector(`[data-order="${focused}"]`) || element(focused) || holder).focus?.();
    for (const [id, text, start, end] of typed) {
      const input = element(id);
      if (!input) continue;
      input.value = text;
      if (document.activeElement === input) input.setSelectionRange(start, end);
    }
  }

  let saidState = "";
  function shown(before) {
    // The header has numbers that change every second: only a new state is said.
    const word = document.querySelector(".banner .state strong").textContent;
    if (word !== saidState) element("state-said").textContent = saidState = word;
    for (const button of document.querySelectorAll("[data-order]")) {
      const order = button.dataset.order;
      button.disabled = order !== "control" && !state.can.includes(order);
    }
    tellAge();
    const names = (of) => JSON.stringify(of.cycles);
    const touches = (of) => JSON.stringify([of.touched, of.deviations, of.ground]);
    if (names(before) !== names(state) || touches(before) !== touches(state)) chooseCycle();
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
    reason: () => ({ order: "hold", reason: element("hold-reason").value.trim(), seen: state.number }),
    resume: () => ({ order: "resume", reason: "", seen: state.number }),
    stop: () => ({ order: "stop", reason: "" }),
    abort: () => ({ order: "abort", reason: "" }),
    loaded: () => ({ order: "loaded" }),
    clear: (button) => ({ order: "clear", device: button.dataset.device }),
    started: (button) => ({ order: "started", map: button.dataset.map || null }),
    done: (button) => ({ order: "done", map: button.dataset.map || null }),
    still: (button) => ({ order: "still", device: button.dataset.device }),
    remark: (button) => ({ order: "remark", alarm: button.dataset.alarm }),
    over: (button) => ({ order: "over", device: button.dataset.device, evidence: element("evidence").value.trim() }),
  };

  document.addEventListener("keydown", (event) => {
    const order = { "hold-reason": "reason", evidence: "over" }[event.target.id];
    if (event.key === "Enter" && order) document.querySelector(`[data-order="${order}"]`)?.click();
  });

  document.addEventListener("click", async (event) => {
    const button = event.target.closest("[data-order]");
    if (!button || button.disabled) return;
    const order = button.dataset.order;
    const needed = element({ over: "evidence", reason: "hold-reason" }[order]);
    if (needed && !needed.value.trim()) {
      needed.focus();
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
  const isCompared = () => view === "difference" || view === "sigma";
  cycles.addEventListener("change", () => {
    chosen = cycles.value === "" || cycles.value === LIVE ? null : Number(cycles.value);
    update();
  });

  /** The choice of the map that grows while the CMM gives its points. */
  const LIVE = "live";
  const isLive = () => state.touched && state.deviations[2] > 0 && !state.cycles.some((of) => of.map && of.cycle === state.cycle);

  /** Lists the cycles that have a map; the one that is measured, or the last one, is shown unless somebody chose another. */
  function chooseCycle() {
    const mapped = state.cycles.filter((of) => of.map);
    const wanted = mapped.map((of) => [String(of.cycle), String(of.cycle)]);
    if (isLive()) wanted.push([`${state.cycle} …`, LIVE]);
    if ([...cycles.options].map((option) => option.value + option.text).join() !== wanted.map(([text, value]) => value + text).join()) {
      cycles.replaceChildren(...wanted.map(([text, value]) => new Option(text, value)));
    }
    const last = isLive() ? LIVE : mapped.length ? String(mapped[mapped.length - 1].cycle) : "";
    cycles.value = mapped.some((of) => of.cycle === chosen) ? String(chosen) : last;
    cycles.disabled = !wanted.length;
    update();
  }

  /** More points than these are drawn at most once a second. */
  const MANY_POINTS = 20000;
  let [isUpdating, isAsked] = [false, false];
  async function update() {
    isAsked = true;
    if (isUpdating) return;
    isUpdating = true;
    while (isAsked) {
      isAsked = false;
      current = await make();
      paint();
      if (current.dots && current.dots.length > MANY_POINTS) await new Promise((resume) => setTimeout(resume, 1000));
    }
    isUpdating = false;
  }

  /** The difference of a cycle has a scale of its own: nothing else is comparable with it. */
  async function limitOf(grid, mapped) {
    const own = regrindMap.roundLimit(regrindMap.statistics(grid.values).limit);
    if (isCompared() || scales.value === "own") return own;
    if (scales.value === "tolerance" && state.toleranceUm) return state.toleranceUm / 2;
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
    const path = view === "map" || view === "sigma" ? await pathOfWheel() : null;
    return { grid, limit, missing, path, ...await dotsOver(grid, limit, at < 0 ? null : mapped[at]) };
  }

  /** The points of the plan until there is a map, or those of the cycle where somebody wants them. */
  async function dotsOver(grid, limit, of) {
    if (view !== "relief" && view !== "difference" && (state.touched || !grid) && (!grid || withPoints)) {
      const plan = await dotsOfPlan(grid ? limit : null);
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

  /** The touches that the machine gave so far, each fetched once: places and deviations. */
  let live = { of: "", places: [], deviations: [] };
  async function touches() {
    const [cycle, batch, count] = state.deviations;
    const of = `${cycle}/${batch}`;
    if (live.of !== of || live.deviations.length > count) live = { of, places: [], deviations: [] };
    if (live.deviations.length < count) {
      const from = live.deviations.length;
      const answer = await fetch(`${base}/touched?from=${from}`).catch(() => null);
      const buffer = answer && answer.ok ? await answer.arrayBuffer() : null;
      const head = buffer && new DataView(buffer);
      if (head && `${head.getUint32(0, true)}/${head.getUint32(4, true)}` === of) {
        const values = new Float32Array(buffer, 12);
        for (let k = 0; k < values.length; k += 3) {
          live.places.push(values[k], values[k + 1]);
          live.deviations.push(values[k + 2]);
        }
      }
    }
    return live;
  }

  /** The scale of the map that grows: that of the other maps where there is one. */
  async function limitOfTouches(values) {
    const mapped = state.cycles.filter((of) => of.map);
    if (scales.value === "tolerance" && state.toleranceUm) return state.toleranceUm / 2;
    const first = scales.value === "first" && mapped.length ? await mapOf(run, mapped[0].cycle, mapped[0].map) : null;
    return regrindMap.roundLimit(regrindMap.statistics(first ? first.values : values).limit);
  }

  /** The points of the plan, and over them what was touched, in the colour of its deviation. */
  async function dotsOfPlan(limitOfMap) {
    planned = planned || await bytes(`${base}/planned`);
    if (!planned) return null;
    const places = new Float32Array(planned);
    const count = places.length / 2;
    const [done, total] = state.touched || [0, count];
    const known = await touches();
    // A batch of chosen touches is drawn over the map of those before it only once it is known.
    if (limitOfMap && !known.deviations.length && total < count) return null;
    const values = regrindMap.levelled(known.places, known.deviations);
    const dotLimit = limitOfMap || await limitOfTouches(values);
    const ink = getComputedStyle(document.body).color.match(/\d+/g).slice(0, 3).map(Number);
    const hues = Array.from({ length: 255 }, (_, k) => (view === "sigma" && limitOfMap ? [255, 255, 255] : Array.from(colours.subarray(3 * k, 3 * k + 3))));
    // A machine that gives no points before the end touches the reference sphere first, and then the part in the order of the plan.
    const inOrder = known.deviations.length || total < count ? 0 : Math.max(0, done - (total - count));
    const dots = [];
    for (let k = 0; k < count; k += 1) {
      const isTouched = k < inOrder;
      dots.push({ at: [places[2 * k], places[2 * k + 1]], size: isTouched ? 2.6 : 1.4, rgb: isTouched ? ink : null });
    }
    const pitch = limitOfMap ? 0 : pitchOf(places);
    values.forEach((value, k) => {
      if (!Number.isNaN(value)) dots.push({ pitch, at: [known.places[2 * k], known.places[2 * k + 1]], size: 2.8, rgb: hues[regrindMap.level(value, dotLimit)] });
    });
    const touched = known.deviations.length || inOrder;
    const words = touched ? [`● ${texts.touched} ${number(touched, 0)}`] : [];
    words.push(`○ ${texts.planned} ${number(count, 0)}`);
    if (values.length) words.push(texts.preliminary);
    return { dots, key: words.join(" · "), dotLimit: values.length && !limitOfMap ? dotLimit : null };
  }

  /** How far apart the points of a plan are, if they lie evenly. */
  function pitchOf(places) {
    const count = places.length / 2;
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let k = 0; k < places.length; k += 2) {
      [x0, y0, x1, y1] = [Math.min(x0, places[k]), Math.min(y0, places[k + 1]), Math.max(x1, places[k]), Math.max(y1, places[k + 1])];
    }
    // A little more than the distance of even points, so that rows of another distance leave no gaps.
    return count > 1 ? 1.15 * Math.sqrt(((x1 - x0) * (y1 - y0)) / count) : 0;
  }

  /** The path of the wheel and the share of it that is ground, while a pass runs. */
  let wheelPoints = null;
  async function pathOfWheel() {
    if (!state.ground) return null;
    wheelPoints = wheelPoints || await bytes(`${base}/path`);
    const [done, total] = state.ground;
    return wheelPoints && total ? { points: new Float32Array(wheelPoints), share: done / total } : null;
  }

  /** The part of the part that is shown: its bounds in millimetres; null for the whole. */
  let zoom = null;
  function wholeFrame() {
    if (!current) return null;
    const places = (current.dots || []).map((dot) => dot.at);
    return current.grid || places.length ? regrindMap.bounds(current.grid, places) : null;
  }

  /** Shows a part of the map that is larger by a factor, around a place that keeps where it is. */
  function zoomBy(factor, place) {
    const whole = wholeFrame();
    if (!whole) return;
    const [x0, y0, x1, y1] = zoom || whole;
    const [x, y] = place || [(x0 + x1) / 2, (y0 + y1) / 2];
    const next = [x + (x0 - x) / factor, y + (y0 - y) / factor, x + (x1 - x) / factor, y + (y1 - y) / factor];
    zoom = next[2] - next[0] >= whole[2] - whole[0] ? null : next[2] - next[0] < (whole[2] - whole[0]) / 64 ? zoom : within(next, whole);
    paint();
  }

  /** The same frame, moved so that it lies within the whole. */
  function within([x0, y0, x1, y1], [wx0, wy0, wx1, wy1]) {
    const [dx, dy] = [Math.max(wx0 - x0, 0) + Math.min(wx1 - x1, 0), Math.max(wy0 - y0, 0) + Math.min(wy1 - y1, 0)];
    return [x0 + dx, y0 + dy, x1 + dx, y1 + dy];
  }

  function panBy(dx, dy) {
    if (!zoom) return;
    zoom = within([zoom[0] + dx, zoom[1] + dy, zoom[2] + dx, zoom[3] + dy], wholeFrame());
    paint();
  }

  document.querySelectorAll("[data-zoom]").forEach((button) => button.addEventListener("click", () => {
    if (button.dataset.zoom === "whole") {
      zoom = null;
      paint();
    } else zoomBy(button.dataset.zoom === "in" ? 2 : 0.5, isPinned ? mark : null);
  }));

  let seen = null;
  function paint() {
    if (!current) return;
    const { grid, limit, dots, path, missing, dotLimit } = current;
    const hues = grid && grid.low === 0 ? unsigned : colours;
    const asRelief = view === "relief" && grid;
    if (asRelief && solid === undefined) solid = regrindRelief.prepare(relief, element("frame"));
    const drawnSolid = asRelief && solid;
    [canvas.hidden, relief.hidden, element("frame").hidden] = [Boolean(drawnSolid), !drawnSolid, !drawnSolid];
    if (drawnSolid) solid.show(grid, limit, colours);
    else seen = regrindMap.draw(canvas, { of: current, frame: zoom, grid, limit: dotLimit || limit, colours: hues, dots, path, mark, missing, isPinned, hasBar: Boolean(grid || dotLimit), most: Math.max(280, innerHeight - 400) });
    scales.disabled = isCompared();
    scales.querySelector("[value=tolerance]").disabled = !state.toleranceUm;
    element("saved").hidden = cycles.value === "" || cycles.value === LIVE;
    for (const link of document.querySelectorAll("[data-file]")) link.href = `${base}/cycles/${cycles.value}/files/${link.dataset.file}`;
    // What is shown decides how wide each picture is.
    const hasSections = Boolean(grid && mark && isPinned && !drawnSolid);
    [element("histogram").hidden, element("sections").hidden] = [!grid, !hasSections];
    if (grid) regrindMap.histogram(element("histogram"), grid, limit, hues);
    if (hasSections) regrindMap.sections(element("sections"), grid, mark, limit);
    read(asRelief && !solid ? texts.noRelief : null);
  }

  /** A number in the language of the page. */
  const number = (value, digits) => value.toLocaleString(document.documentElement.lang, { minimumFractionDigits: digits, maximumFractionDigits: digits });

  /** Says what the map is, and what it has at the mark, or in all. */
  function read(instead) {
    const { grid, key } = current;
    const extent = grid && { wide: grid.columns * grid.stepX, deep: grid.rows * grid.stepY, limit: current.limit };
    const help = !relief.hidden && grid ? [`${texts.heights} × ${number(regrindRelief.heightFactor(extent), 0)}`] : isPinned ? [] : [texts.sectionHelp];
    const walked = current.path ? [`● ${texts.wheel} ${number(100 * current.path.share, 0)} %`] : [];
    caption.textContent = grid
      ? [...walked, `${number(grid.columns * grid.stepX, 0)} × ${number(grid.rows * grid.stepY, 0)} mm`, ...(grid.low < 0 ? [texts.sign] : []), ...help].join(" · ")
      : [...walked, ...(key ? [key] : [])].join(" · ");
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
    // The uncertainty of a difference is not that of one map.
    const known = isCompared() || !Number.isFinite(grid.sigma[node]) ? "" : ` ± ${number(2 * grid.sigma[node], 2)}`;
    const words = Number.isNaN(value) ? "–" : `${sign}${number(Math.abs(value), 2)}${known} µm`;
    reading.textContent = `x ${number(mark[0], 2)} mm, y ${number(mark[1], 2)} mm: ${words}`;
  }

  /** Whether the mark stays where somebody put it, with two sections through it. It is dragged, and goes with a double click. */
  let isPinned = false;
  let isDragged = false;
  function moveMark(event) {
    if (!seen || !current || !current.grid) return;
    const box = canvas.getBoundingClientRect();
    mark = seen.toPart(event.clientX - box.left, event.clientY - box.top);
    paint();
  }
  /** Where a pan began: the place of the part under the pointer. */
  let panned = null;
  let hasPanned = false;
  const placeOf = (event) => {
    const box = canvas.getBoundingClientRect();
    return seen.toPart(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerdown", (event) => {
    isDragged = isPinned;
    [panned, hasPanned] = [zoom && seen && !isPinned ? [...placeOf(event), event.clientX, event.clientY] : null, false];
  });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey || !seen) return;
    event.preventDefault();
    zoomBy(event.deltaY < 0 ? 1.25 : 0.8, placeOf(event));
  }, { passive: false });
  // A finger that scrolls the page gives no click, and a pan pins nothing.
  canvas.addEventListener("click", (event) => {
    if (hasPanned) return;
    isPinned = Boolean(current && current.grid);
    moveMark(event);
  });
  for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { [isDragged, panned] = [false, null]; });
  canvas.addEventListener("pointermove", (event) => {
    if (panned && event.buttons && seen) {
      // A hand that only clicks moves a little too.
      hasPanned = hasPanned || Math.hypot(event.clientX - panned[2], event.clientY - panned[3]) > 4;
      if (!hasPanned) return;
      const [x, y] = placeOf(event);
      return panBy(panned[0] - x, panned[1] - y);
    }
    if (isDragged || !isPinned) moveMark(event);
  });
  canvas.addEventListener("pointerleave", () => {
    if (isPinned) return;
    mark = null;
    paint();
  });
  canvas.addEventListener("dblclick", () => {
    [isPinned, mark] = [false, null];
    paint();
  });
  canvas.addEventListener("keydown", (event) => {
    const grid = current && current.grid;
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.key === "Escape") {
      [isPinned, mark] = [false, null];
      paint();
    }
    const closer = { "+": 2, "=": 2, "-": 0.5 }[event.key];
    if (closer) zoomBy(closer, mark);
    if (event.key === "0") {
      zoom = null;
      paint();
    }
    if (!step || !grid) return;
    event.preventDefault();
    if (event.shiftKey && zoom) return panBy(step[0] * 0.1 * (zoom[2] - zoom[0]), step[1] * 0.1 * (zoom[3] - zoom[1]));
    isPinned = true;
    const middle = [grid.firstX + grid.stepX * (grid.columns >> 1), grid.firstY + grid.stepY * (grid.rows >> 1)];
    mark = (mark || middle).map((place, k) => place + step[k] * (k ? grid.stepY : grid.stepX));
    paint();
  });

  addEventListener("resize", paint);
  document.addEventListener("regrind-theme", update);
  shown(state);
  chooseCycle();
})();
