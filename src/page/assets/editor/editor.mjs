// Editor of recipes: CodeMirror with TOML, completion, problems below their lines, and a comparison of two texts.
import { autocompletion, closeBrackets, closeBracketsKeymap, completionKeymap, startCompletion } from "@codemirror/autocomplete";
import { defaultKeymap, history, historyKeymap } from "@codemirror/commands";
import { HighlightStyle, StreamLanguage, bracketMatching, syntaxHighlighting } from "@codemirror/language";
import { toml } from "@codemirror/legacy-modes/mode/toml";
import { MergeView } from "@codemirror/merge";
import { highlightSelectionMatches, search, searchKeymap } from "@codemirror/search";
import { EditorState, RangeSetBuilder, StateEffect, StateField } from "@codemirror/state";
import {
  Decoration, EditorView, GutterMarker, WidgetType, drawSelection, gutterLineClass, highlightActiveLine, highlightActiveLineGutter,
  keymap, lineNumbers,
} from "@codemirror/view";
import { tags } from "@lezer/highlight";

const theme = EditorView.theme({
  "&": { height: "100%", fontSize: "13px", color: "var(--ink)", backgroundColor: "var(--ground)" },
  "&.cm-focused": { outline: "2px solid var(--link)", outlineOffset: "-2px" },
  ".cm-scroller": { fontFamily: '"JetBrains Mono", "DejaVu Sans Mono", Consolas, monospace', lineHeight: "1.55", overflow: "auto" },
  ".cm-content": { caretColor: "var(--ink)" },
  ".cm-cursor": { borderLeftColor: "var(--ink)" },
  ".cm-gutters": { backgroundColor: "var(--ground)", color: "var(--quiet)", border: "none" },
  ".cm-activeLine, .cm-activeLineGutter": { backgroundColor: "color-mix(in srgb, var(--track) 40%, transparent)" },
  "&.cm-focused .cm-selectionBackground, .cm-selectionBackground": { backgroundColor: "color-mix(in srgb, var(--accent) 30%, transparent) !important" },
  ".cm-selectionMatch": { backgroundColor: "color-mix(in srgb, var(--amber) 25%, transparent)" },
  ".regrind-problem-line": { backgroundColor: "color-mix(in srgb, var(--alarm) 12%, transparent)" },
  ".cm-gutterElement.regrind-problem-line": { boxShadow: "inset 3px 0 var(--alarm)" },
  ".regrind-problem": {
    backgroundColor: "color-mix(in srgb, var(--alarm) 12%, transparent)", color: "var(--ink)", fontFamily: "inherit", whiteSpace: "normal",
    padding: "1px 8px 4px 6px", overflowWrap: "anywhere", borderLeft: "3px solid var(--alarm)",
  },
  ".regrind-problem.is-note": { backgroundColor: "color-mix(in srgb, var(--amber) 12%, transparent)", borderLeftColor: "var(--amber)" },
  ".cm-tooltip": { backgroundColor: "var(--ground)", color: "var(--ink)", border: "1px solid var(--line)", borderRadius: "6px" },
  ".cm-tooltip.cm-tooltip-autocomplete > ul": { fontFamily: "inherit", maxHeight: "14em" },
  ".cm-tooltip-autocomplete ul li[aria-selected]": { backgroundColor: "var(--accent)", color: "var(--on-accent)" },
  ".cm-completionDetail": { color: "inherit", opacity: ".75" },
  ".cm-completionInfo": { maxWidth: "24rem", padding: "6px 10px", whiteSpace: "normal" },
  ".cm-panels": { backgroundColor: "var(--panel)", color: "var(--ink)" },
  ".cm-textfield, .cm-button": { backgroundColor: "var(--ground)", color: "var(--ink)", backgroundImage: "none", border: "1px solid var(--quiet)" },
  ".cm-collapsedLines": { color: "var(--quiet)", background: "var(--panel)" },
  ".cm-collapsedLines:before, .cm-collapsedLines:after": { content: '"⋯"' },
  ".cm-changedLine": { backgroundColor: "color-mix(in srgb, var(--accent) 12%, transparent) !important" },
  ".cm-changedText": { background: "color-mix(in srgb, var(--accent) 35%, transparent) !important" },
});

const colours = HighlightStyle.define([
  { tag: tags.propertyName, color: "var(--link)" },
  { tag: [tags.atom, tags.number, tags.bool], color: "var(--rms)" },
  { tag: tags.string, color: "var(--runs)" },
  { tag: tags.comment, color: "var(--quiet)", fontStyle: "italic" },
  { tag: tags.bracket, fontWeight: "650" },
]);

/** One problem as lines of text below the line that has it. */
class ProblemWidget extends WidgetType {
  constructor(problem) {
    super();
    this.problem = problem;
  }
  eq(other) {
    return other.problem.words === this.problem.words && other.problem.isNote === this.problem.isNote;
  }
  toDOM() {
    const shown = document.createElement("div");
    shown.className = this.problem.isNote ? "regrind-problem is-note" : "regrind-problem";
    shown.textContent = this.problem.words;
    return shown;
  }
  ignoreEvent() {
    return false;
  }
}

class ProblemMarker extends GutterMarker {
  constructor() {
    super();
    this.elementClass = "regrind-problem-line";
  }
}

const marker = new ProblemMarker();
const setProblems = StateEffect.define();

/** Problems in the order of their lines. They move with the text until the next check. */
const problemField = StateField.define({
  create: () => ({ lines: Decoration.none, markers: Decoration.none }),
  update(shown, transaction) {
    let next = { lines: shown.lines.map(transaction.changes), markers: shown.markers.map(transaction.changes) };
    for (const effect of transaction.effects) {
      if (effect.is(setProblems)) next = decorations(effect.value, transaction.state.doc);
    }
    return next;
  },
  provide: (field) => [EditorView.decorations.from(field, (shown) => shown.lines), gutterLineClass.from(field, (shown) => shown.markers)],
});

function decorations(problems, doc) {
  const [lines, markers] = [new RangeSetBuilder(), new RangeSetBuilder()];
  const placed = problems.map((problem) => ({ problem, line: doc.line(Math.min(Math.max(problem.line, 1), doc.lines)) }));
  placed.sort((a, b) => a.line.from - b.line.from);
  let last = -1;
  for (const { problem, line } of placed) {
    if (line.from !== last && !problem.isNote) {
      lines.add(line.from, line.from, Decoration.line({ class: "regrind-problem-line" }));
      markers.add(line.from, line.from, marker);
    }
    last = line.from;
    lines.add(line.to, line.to, Decoration.widget({ widget: new ProblemWidget(problem), side: 1, block: true }));
  }
  return { lines: lines.finish(), markers: markers.finish() };
}

const common = () => [
  lineNumbers(), StreamLanguage.define(toml), syntaxHighlighting(colours), theme, EditorView.lineWrapping,
];

/** Makes an editor in `host`, a shadow root. `changed` is called after each change, `complete` gives the completions at a place. */
export function edit(host, { text, label, changed, complete, isReadOnly }) {
  const view = new EditorView({
    root: host,
    parent: host,
    state: EditorState.create({
      doc: text,
      extensions: [
        ...common(), history(), drawSelection(), bracketMatching(), closeBrackets(), highlightActiveLine(), highlightActiveLineGutter(),
        highlightSelectionMatches(), search({ top: true }), problemField,
        EditorState.readOnly.of(Boolean(isReadOnly)),
        autocompletion({ override: [complete], activateOnTyping: true, icons: false }),
        keymap.of([...closeBracketsKeymap, ...defaultKeymap, ...historyKeymap, ...searchKeymap, ...completionKeymap]),
        EditorView.contentAttributes.of({ "aria-label": label, spellcheck: "false", tabindex: "0" }),
        EditorView.updateListener.of((update) => { if (update.docChanged) changed(update.state.doc.toString()); }),
      ],
    }),
  });
  return {
    text: () => view.state.doc.toString(),
    setText: (next) => view.dispatch({ changes: { from: 0, to: view.state.doc.length, insert: next } }),
    showProblems: (problems) => view.dispatch({ effects: setProblems.of(problems) }),
    goTo: (line) => {
      const { from } = view.state.doc.line(Math.min(Math.max(line, 1), view.state.doc.lines));
      view.dispatch({ selection: { anchor: from }, effects: EditorView.scrollIntoView(from, { y: "center" }) });
      view.focus();
    },
    focus: () => view.focus(),
    complete: () => startCompletion(view),
    view,
  };
}

/** Shows two texts side by side in `host`, a shadow root, under `labels`. Lines without a change are folded: `unchanged` tells their number. */
export function compare(host, { before, after, labels, unchanged }) {
  const side = (doc, label) => ({
    doc,
    extensions: [
      ...common(), EditorState.readOnly.of(true), EditorView.editable.of(false), EditorState.phrases.of({ "$ unchanged lines": unchanged }),
      EditorView.contentAttributes.of({ "aria-label": label, tabindex: "0" }),
    ],
  });
  return new MergeView({ a: side(before, labels[0]), b: side(after, labels[1]), root: host, parent: host, collapseUnchanged: { margin: 3, minSize: 6 }, gutter: true });
}
