// A recipe is written: each text is checked, planned and drawn; it is simulated and saved on request.
"use strict";
/** Completions of a recipe from its schema: tables, keys and values. */
const regrindCompletion = (() => {
  /** Follows references and choices, so that each schema is an object with its own type. */
  function resolved(schema, whole, depth = 0) {
    if (!schema || depth > 8) return schema || {};
    if (schema.$ref) {
      const found = schema.$ref.split("/").slice(1).reduce((at, key) => at && at[key.replaceAll("~1", "/").replaceAll("~0", "~")], whole);
      return resolved({ ...found, ...schema, $ref: undefined }, whole, depth + 1);
    }
    const choices = (schema.anyOf || schema.oneOf || schema.allOf || []).filter((choice) => choice.type !== "null");
    if (choices.length === 1) return resolved({ ...choices[0], description: schema.description || choices[0].description }, whole, depth + 1);
    return schema;
  }

  /** All properties of an object with choices. */
  function properties(schema, whole) {
    const of = resolved(schema, whole);
    const inner = [...(of.oneOf || []), ...(of.anyOf || []), ...(of.allOf || [])].map((choice) => properties(choice, whole));
    return Object.assign({}, ...inner, of.properties || {});
  }

  const isTable = (schema) => Object.keys(schema.properties || {}).length > 0 || (schema.oneOf || schema.anyOf || []).some((choice) => choice.properties || choice.$ref);

  function at(whole, path) {
    return path.reduce((schema, key) => {
      const of = resolved(schema, whole);
      const next = properties(of.items ? of.items : of, whole)[key];
      return next ? resolved(next, whole) : {};
    }, whole);
  }

  const info = (schema) => (schema.description || "").split("\n\n")[0];
  function range(schema) {
    const [low, high] = [schema.minimum ?? schema.exclusiveMinimum, schema.maximum ?? schema.exclusiveMaximum];
    const limits = [low, high].map((limit) => (limit === undefined ? "" : String(limit)));
    const type = [].concat(schema.type || []).filter((name) => name !== "null").join(" | ");
    return limits.some(Boolean) ? `${type} ${limits.join(" … ")}` : type;
  }

  function values(schema, whole) {
    const of = resolved(schema, whole);
    const listed = [of, ...(of.oneOf || []), ...(of.anyOf || [])].map((choice) => resolved(choice, whole));
    const all = listed.flatMap((choice) => [...(choice.enum || []), ...("const" in choice ? [choice.const] : [])].map((value) => [value, choice]));
    if ([].concat(of.type).includes("boolean")) all.push([true, of], [false, of]);
    const seen = new Set();
    return all.filter(([value]) => value !== null && !seen.has(value) && seen.add(value));
  }

  /** All tables of the schema with their paths. */
  function tables(schema, whole, path = [], found = []) {
    for (const [key, inner] of Object.entries(properties(schema, whole))) {
      const of = resolved(inner, whole);
      if (path.length < 4 && isTable(of)) {
        found.push([[...path, key], of]);
        tables(of, whole, [...path, key], found);
      }
    }
    return found;
  }

  /** Table that a line belongs to. */
  function tableAbove(lines, row) {
    for (let k = row; k >= 0; k -= 1) {
      const head = lines[k].match(/^\s*\[\[?([^\]]+)\]/);
      if (head) return [head[1].split(".").map((key) => key.trim()), k];
    }
    return [[], -1];
  }

  /** The source of completions for CodeMirror. */
  const source = (schema) => (context) => {
    const line = context.state.doc.lineAt(context.pos);
    const before = line.text.slice(0, context.pos - line.from);
    const lines = context.state.doc.toString().split("\n");
    const head = before.match(/^\s*\[+([\w.]*)$/);
    if (head) {
      const from = context.pos - head[1].length;
      return { from, options: tables(schema, schema).map(([path, of]) => ({ label: path.join("."), info: info(of), apply: path.join(".") })), validFor: /^[\w.]*$/ };
    }
    const [table, begins] = tableAbove(lines, line.number - 1);
    const value = before.match(/^\s*([\w.]+)\s*=\s*\[?.*?("?)([\w-]*)$/);
    if (value) {
      const options = values(at(schema, [...table, ...value[1].split(".")]), schema).map(([choice, of]) => ({
        label: String(choice), info: info(of), apply: typeof choice === "string" ? (value[2] ? choice : `"${choice}"`) : String(choice),
      }));
      return options.length ? { from: context.pos - value[3].length, options, validFor: /^[\w-]*$/ } : null;
    }
    const key = before.match(/^\s*(\w*)$/);
    if (!key || (!key[1] && !context.explicit)) return null;
    const used = new Set();
    for (let k = begins + 1; k < lines.length && !/^\s*\[/.test(lines[k]); k += 1) {
      const written = lines[k].match(/^\s*(\w+)\s*=/);
      if (written) used.add(written[1]);
    }
    const of = at(schema, table);
    const required = new Set(resolved(of, schema).required || []);
    const options = Object.entries(properties(of, schema)).filter(([name]) => !used.has(name)).map(([name, inner]) => {
      const known = resolved(inner, schema);
      return isTable(known) && !known.items
        ? { label: name, detail: "table", info: info(known), apply: `[${[...table, name].join(".")}]\n` }
        : { label: name, detail: range(known), info: info(inner) || info(known), apply: `${name} = `, boost: required.has(name) ? 10 : 0 };
    });
    return { from: context.pos - key[1].length, options, validFor: /^\w*$/ };
  };

  return { source };
})();

const regrindWorkbench = (() => {
  const element = (id) => document.getElementById(id);
  const data = () => JSON.parse(element("data").textContent);
  /** Time after a key before the text is checked. */
  const WAIT_MS = 250;

  const number = (value, digits = 3) => value.toLocaleString(document.documentElement.lang, { maximumSignificantDigits: digits });
  const filled = (text, value) => text.replace("{}", value);

  function made(tag, properties = {}, ...children) {
    const node = Object.assign(document.createElement(tag), properties);
    node.append(...children);
    return node;
  }

  /** Lines of JSON of an answer, each as soon as it has come. */
  async function eachLine(answer, act) {
    const [reader, decoder] = [answer.body.getReader(), new TextDecoder()];
    let rest = "";
    for (;;) {
      const { done, value } = await reader.read();
      rest += decoder.decode(value || new Uint8Array(), { stream: !done });
      const lines = rest.split("\n");
      rest = lines.pop();
      lines.filter(Boolean).forEach((line) => act(JSON.parse(line)));
      if (done) return;
    }
  }

  /** An answer that cannot be used, in words. A sign-in page in place of JSON is an answer to a person who is signed out. */
  async function refusal(answer, texts) {
    const isJson = (answer.headers.get("content-type") || "").includes("json");
    if (isJson) return (await answer.json()).message;
    return answer.ok || answer.status === 401 || answer.status === 403 ? texts.signedOut : `${answer.status} ${await answer.text()}`.trim();
  }

  /** A text without the difference of line ends, as the editor has it. */
  const plain = (text) => (text === null ? null : text.replaceAll("\r\n", "\n").replaceAll("\r", "\n"));
  /** A text of the editor with the line ends of a file. */
  const withEndsOf = (file, text) => (file && file.includes("\r\n") && !/(^|[^\r])\n/.test(file) ? text.replaceAll("\n", "\r\n") : text);
  /** The bytes of an answer as text. A mark of the byte order stays, because it is part of the file. */
  const textOf = async (answer) => new TextDecoder("utf-8", { ignoreBOM: true }).decode(await answer.arrayBuffer());

  function problemText({ found, allowed, remedy, key }) {
    return [`${key ? `${key} ` : ""}${found}`, allowed, remedy].filter(Boolean).join("; ");
  }

  /** Rows of the plan: what it is, and its figures. */
  function planRows(plan, texts) {
    const rows = [];
    const add = (name, ...values) => rows.push([name, values.filter(Boolean).map((value, k, all) => `${value}${k + 1 < all.length ? "," : ""}`.replaceAll(" ", "\u00a0")).join(" ")]);
    const least = plan.least_measuring_minutes;
    add(texts.measuring, plan.targets ? `${number(plan.targets, 6)} ${texts.touches}` : "", least === undefined ? "" : filled(texts.atLeastMinutes, number(least)));
    add(texts.pass, `${number(plan.tracks, 6)} ${texts.trackCount}`, filled(texts.minutes, number(plan.grinding_minutes)));
    add(texts.allPasses, `${texts.atMostCycles} ${plan.most_cycles}`, `≥ ${number(plan.least_hours_to_last)} h`);
    if (plan.scallops) {
      const limit = plan.scallops.allowed_pv_um;
      add(texts.scallops, `${number(plan.scallops.pv_um)} µm`, limit === undefined ? "" : `${texts.ofLimit} ${number(limit)} µm`);
    }
    add(texts.removed, `${number(plan.removed_mm3_a_pass)} mm³`);
    if (plan.wheel_loss_mm3_a_pass !== undefined) add(texts.wheelLoss, `${number(plan.wheel_loss_mm3_a_pass)} mm³`);
    add(texts.budget, `${number(plan.removal_budget_um)} µm`);
    return rows;
  }

  function planNodes(plan, texts) {
    const list = made("dl", { className: "rows" });
    for (const [name, value] of planRows(plan, texts)) list.append(made("dt", { textContent: name }), made("dd", { textContent: value }));
    const weak = plan.weak_directions.map(({ words }) => made("p", { className: "warns weak" }, made("strong", { textContent: `${texts.weak}: ` }), made("span", { lang: "en", textContent: `${words}. ` }), texts.weakRemedy));
    const warnings = plan.warnings.map((words) => made("p", { className: "warns" }, made("strong", { textContent: `${texts.warning}: ` }), words));
    return [list, ...weak, ...warnings];
  }

  function begin() {
    const { name, text, skeleton, versions, texts, simulated, person, folder } = data();
    const path = `/recipes/${encodeURIComponent(name)}`;
    /** Text of the file as this page knows it; null for a file that does not exist. */
    let onDisk = text;
    let [shape, view, checking, isGood] = [null, "surface", null, false];
    const hosts = Object.fromEntries(["editor", "texts"].map((id) => [id, element(id).attachShadow({ mode: "open" })]));
    const scene = regrindScene.prepare(element("solid"), element("marks"));
    const say = (words, isBad = false) => {
      element("said").replaceChildren(words);
      element("said").classList.toggle("no", isBad);
    };

    const draft = keptText(`regrind-draft ${JSON.stringify([person, folder, name])}`);
    const found = draft.get();
    const first = found ? found.text : plain(text) ?? skeleton;
    let complete = () => null;
    const editor = codeMirror.edit(hosts.editor, { text: first, label: texts.editor, changed, complete: (context) => complete(context) });
    fetch("/recipe-schema").then((answer) => answer.json()).then((schema) => { complete = regrindCompletion.source(schema); }).catch(() => {});
    if (found && found.text !== plain(text)) {
      // A text that was written over another one does not overwrite it unseen.
      const isOld = found.base !== text;
      if (isOld) onDisk = found.base;
      const discard = made("button", { type: "button", textContent: texts.discardDraft });
      discard.addEventListener("click", () => {
        onDisk = text;
        editor.setText(plain(onDisk) ?? skeleton);
        draft.remove();
        say("");
      });
      say(isOld ? texts.draftOfOldFile : texts.draftKept, isOld);
      element("said").append(" ", discard);
    }

    function changed() {
      const now = editor.text();
      const isChanged = now !== (plain(onDisk) ?? skeleton);
      element("changed").hidden = !isChanged;
      if (isChanged) draft.set({ text: now, base: onDisk });
      else draft.remove();
      setGood(false);
      isSaveWished = false;
      markSimulation();
      element("problem-count").textContent = texts.checks;
      clearTimeout(checking);
      checking = setTimeout(check, WAIT_MS);
    }

    function setGood(good) {
      isGood = good;
      element("simulate").disabled = !good;
      element("save").disabled = !good || editor.text() === plain(onDisk);
    }

    let [aborted, problems, isFault] = [new AbortController(), [], false];
    async function check() {
      aborted.abort();
      aborted = new AbortController();
      const { signal } = aborted;
      const sent = editor.text();
      problems = [];
      try {
        const answer = await fetch(`${path}/draft`, { method: "POST", body: sent, headers: { "Content-Type": "text/plain" }, signal });
        if (answer.status === 503) {
          // Other texts are checked: this one comes after them.
          checking = setTimeout(check, 1000);
          return;
        }
        const isLines = (answer.headers.get("content-type") || "").includes("ndjson");
        if (!answer.ok || !isLines) throw new Error(await refusal(answer, texts));
        if (isFault) say("");
        isFault = false;
        let last = "";
        await eachLine(answer, (line) => {
          last = line.kind;
          if (!signal.aborted && editor.text() === sent) take(line);
        });
        // The program was ended at its limit of time or size: what is shown is not that of this text.
        if (!signal.aborted && !(["shape", "refused"].includes(last) || problems.length)) showNoPlan(texts.noAnswer, true);
      } catch (error) {
        if (signal.aborted) return;
        isFault = true;
        say(error instanceof TypeError ? texts.pageGone : String(error.message || error), true);
        showNoPlan(texts.noAnswer, true);
        element("problem-count").textContent = texts.noAnswer;
      }
    }

    function take(line) {
      if (line.kind === "checked") {
        problems = line.problems;
        const notes = line.notes.map((words) => ({ line: Number((words.match(/line (\d+)/) || [0, 1])[1]), words, isNote: true }));
        editor.showProblems([...problems.map((problem) => ({ line: problem.line, words: problemText(problem) })), ...notes]);
        element("problem-count").textContent = problems.length ? `${texts.problems} ${problems.length}` : texts.noProblem;
        element("problem-count").classList.toggle("has-problems", problems.length > 0);
        if (problems.length) showNoPlan(texts.noPlan);
        else {
          setGood(true);
          showNoPlan(texts.checks);
        }
        if (isSaveWished) {
          isSaveWished = false;
          save();
        }
      } else if (line.kind === "refused") {
        showNoPlan(line.reason, true);
      } else if (line.kind === "planned") {
        element("plan").replaceChildren(...planNodes(line.plan, texts));
      } else if (line.kind === "shape") {
        shape = line;
        draw();
      }
    }

    function showNoPlan(words, isBad = false) {
      element("plan").replaceChildren(made("p", { className: isBad ? "warns" : "quiet", textContent: words }));
      shape = null;
      draw();
    }

    function draw() {
      element("no-picture").hidden = Boolean(shape);
      element("legend").replaceChildren();
      if (!scene) return;
      if (!shape) {
        scene.clear();
        return;
      }
      const { times, scallopsNm } = scene.show(shape, view);
      const legend = [];
      const item = (className, words) => legend.push(made("span", { className }, words));
      if (view === "surface") {
        const nth = (every) => (every > 1 ? `, ${texts.everyNth} ${every}` : "");
        if (shape.tracks_mm.length) item("of-tracks", `${texts.tracks}${nth(shape.every_track)}`);
        if (shape.targets_mm.length) item("of-targets", `${texts.targets}${nth(shape.every_target)}`);
      } else if (view === "scallops" && shape.scallops_nm.length) {
        item("of-scale", scallopsNm.map((nm) => `${number(nm)} nm`).join(" … "));
      }
      item("", `${texts.heightsTimes} ${number(times, 2)}`);
      element("legend").append(...legend);
    }

    document.querySelectorAll("[data-view]").forEach((button) => button.addEventListener("click", () => {
      view = button.dataset.view;
      document.querySelectorAll("[data-view]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
      draw();
    }));
    element("whole").addEventListener("click", () => scene && scene.reset());
    element("theme").addEventListener("change", () => setTimeout(draw));
    element("problem-count").addEventListener("click", () => (problems.length ? editor.goTo(problems[0].line) : editor.focus()));

    const listed = element("compared");
    function listVersion(version) {
      const who = version.damaged ? texts.damaged : version.saved_by || (version.saved_at ? "" : texts.otherProgram);
      const at = version.saved_at ? new Date(version.saved_at).toLocaleString(document.documentElement.lang, { dateStyle: "medium", timeStyle: "short" }) : "";
      const words = [`${texts.version} ${version.version}`, at, who].filter(Boolean).join(" · ");
      listed.insertBefore(made("option", { value: String(version.version), textContent: words }), listed.options[2] || null);
    }
    versions.forEach(listVersion);
    /** Adds the versions that the list does not have yet: a save can make two. */
    async function listNewVersions() {
      const answer = await fetch(`${path}/versions`);
      const known = new Set([...listed.options].map((option) => option.value));
      if (answer.ok) (await answer.json()).filter(({ version }) => !known.has(String(version))).forEach(listVersion);
    }
    let left = "";
    const showComparison = (isShown) => {
      element("comparison").hidden = !isShown;
      element("editor").hidden = isShown;
      if (!isShown) listed.value = "";
    };
    listed.addEventListener("change", async () => {
      const chosen = listed.value;
      if (!chosen) return showComparison(false);
      const of = chosen === "file" ? `${path}/text` : `${path}/versions/${chosen}`;
      try {
        const answer = await fetch(of);
        if (!answer.ok) throw new Error(await refusal(answer, texts));
        const read = await textOf(answer);
        // Another version was chosen meanwhile.
        if (listed.value !== chosen) return undefined;
        left = plain(read);
        if (chosen === "file") {
          onDisk = read;
          if (editor.text() !== left) draft.set({ text: editor.text(), base: onDisk });
          setGood(isGood);
        }
        hosts.texts.replaceChildren();
        showComparison(true);
        if (left === editor.text()) hosts.texts.append(made("p", { textContent: texts.noDifference }));
        else codeMirror.compare(hosts.texts, { before: left, after: editor.text(), labels: [texts.before, texts.after], unchanged: texts.unchangedLines });
      } catch (error) {
        showComparison(false);
        say(String(error.message || error), true);
      }
      return undefined;
    });
    element("close-comparison").addEventListener("click", () => showComparison(false));
    element("take-text").addEventListener("click", () => {
      editor.setText(left);
      showComparison(false);
    });

    let [isSaving, isSaveWished] = [false, false];
    async function save() {
      if (isSaving || editor.text() === plain(onDisk)) return;
      if (!isGood) {
        // The check of this text is under way: it is saved as soon as it is found good.
        isSaveWished = !problems.length;
        say(texts.hasProblems, true);
        return;
      }
      isSaving = true;
      const sent = editor.text();
      const content = withEndsOf(onDisk, sent);
      try {
        const answer = await regrindPost(`${path}/save`, JSON.stringify({ text: content, replaces: onDisk }));
        if (!answer.ok) throw new Error(await refusal(answer, texts));
        const said = await answer.json();
        onDisk = content;
        await listNewVersions();
        element("version").textContent = `${texts.version} ${said.version}`;
        say(`${texts.saved} ${said.version}`);
        element("changed").hidden = editor.text() === sent;
        if (editor.text() === sent) draft.remove();
        else draft.set({ text: editor.text(), base: onDisk });
        setGood(isGood);
      } catch (error) {
        say(error instanceof TypeError ? texts.pageGone : String(error.message || error), true);
      } finally {
        isSaving = false;
      }
    }
    element("save").addEventListener("click", save);
    document.addEventListener("keydown", (event) => {
      if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "s") {
        event.preventDefault();
        save();
      }
    });

    /** Simulation that is shown: its number and its text; null if none is shown. */
    let [events, shown] = [null, simulated];
    function markSimulation() {
      element("earlier-text").hidden = !shown || shown.text === editor.text();
    }
    function follow() {
      if (events) events.close();
      if (!shown) return;
      const { id } = shown;
      events = new EventSource(`${path}/simulation/events?id=${id}`);
      events.onmessage = ({ data: sent }) => {
        const { html, isOver } = JSON.parse(sent);
        element("simulation").innerHTML = html;
        element("end-simulation").hidden = isOver;
        markSimulation();
        if (!isOver) return;
        events.close();
        const figure = element("last-map");
        const picture = figure.querySelector("img");
        picture.src = `${picture.dataset.src}?id=${id}`;
        picture.onload = () => { figure.hidden = false; };
        figure.querySelector("a").href = `${figure.querySelector("a").dataset.href}?id=${id}`;
      };
      events.onerror = () => {
        // The browser tries again by itself, unless the page has refused the stream.
        if (events.readyState === EventSource.CLOSED) say(texts.pageGone, true);
      };
    }
    element("simulate").addEventListener("click", async () => {
      const field = element("seed");
      if (!field.value || !field.checkValidity()) return say(texts.badSeed, true);
      const sent = editor.text();
      element("simulation").replaceChildren(made("p", { className: "quiet", textContent: texts.simulates }));
      element("last-map").hidden = true;
      try {
        const answer = await regrindPost(`${path}/simulation`, JSON.stringify({ text: sent, seed: Number(field.value) }));
        if (!answer.ok) throw new Error(await refusal(answer, texts));
        shown = { id: (await answer.json()).id, text: sent };
        follow();
      } catch (error) {
        element("simulation").replaceChildren(made("p", { className: "warns", textContent: error instanceof TypeError ? texts.pageGone : String(error.message || error) }));
      }
      return undefined;
    });
    element("end-simulation").addEventListener("click", async () => {
      element("end-simulation").hidden = true;
      // The stream of events tells the end.
      if (shown) await regrindPost(`${path}/simulation/end?id=${shown.id}`, "");
    });
    follow();
    changed();
    return { editor, text: editor.text };
  }

  /** Text that this browser keeps for a recipe until it is saved. */
  function keptText(key) {
    const safely = (act) => {
      try {
        return act();
      } catch {
        return null;
      }
    };
    /** Name of this tab, which a reload keeps. */
    const tab = safely(() => sessionStorage.getItem("regrind-tab")) || String(Math.random());
    safely(() => sessionStorage.setItem("regrind-tab", tab));
    const read = () => safely(() => JSON.parse(localStorage.getItem(key)));
    return {
      get: () => {
        const found = read();
        return found && typeof found.text === "string" ? found : null;
      },
      set: (draft) => safely(() => localStorage.setItem(key, JSON.stringify({ ...draft, tab }))),
      // A text that another tab has kept stays.
      remove: () => safely(() => { if ((read() || {}).tab === tab) localStorage.removeItem(key); }),
    };
  }

  return { begin };
})();
document.addEventListener("DOMContentLoaded", () => { window.regrindOpened = regrindWorkbench.begin(); });
