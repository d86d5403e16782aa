// The editor of rule files: CodeMirror with YAML, colors for the line language, completion and diagnostics.

import { autocompletion, closeBrackets, completionKeymap, defaultKeymap, history, historyKeymap, indentWithTab, yaml,
  HighlightStyle, bracketMatching, indentOnInput, syntaxHighlighting, lintGutter, setDiagnostics,
  highlightSelectionMatches, searchKeymap, EditorState, StateEffect, Decoration, EditorView, MatchDecorator,
  ViewPlugin, drawSelection, hoverTooltip, keymap, lineNumbers, highlightActiveLine, highlightActiveLineGutter, tags } from "./parts/editor.js";
import { compiler } from "./compiler.js";
import { make } from "./dom.js";

const STYLE = HighlightStyle.define([
  { tag: tags.propertyName, class: "key" },
  { tag: tags.definition(tags.propertyName), class: "key" },
  { tag: tags.comment, class: "comment" },
  { tag: [tags.string, tags.attributeValue], class: "string" },
  { tag: [tags.punctuation, tags.separator, tags.brace, tags.squareBracket], class: "mark" },
]);

const THEME = EditorView.theme({
  "&": { height: "100%", fontSize: "13px", backgroundColor: "var(--sheet)", color: "var(--text)" },
  ".cm-scroller": { fontFamily: 'ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace', lineHeight: "1.5" },
  ".cm-gutters": { backgroundColor: "var(--sheet)", color: "var(--soft)", border: "none" },
  ".cm-activeLine, .cm-activeLineGutter": { backgroundColor: "light-dark(#0000000a, #ffffff0c)" },
  ".cm-content": { caretColor: "var(--text)" },
  ".cm-cursor": { borderLeftColor: "var(--text)" },
  "&.cm-focused .cm-selectionBackground, .cm-selectionBackground": { backgroundColor: "light-dark(#b9d4fb, #31507d) !important" },
  ".cm-tooltip": { backgroundColor: "var(--sheet)", border: "1px solid var(--line)", borderRadius: "6px", maxWidth: "560px" },
  ".cm-diagnostic": { whiteSpace: "pre-wrap" },
  ".about": { whiteSpace: "pre-wrap", padding: "6px 10px" },
  ".key": { color: "light-dark(#7a2e8e, #d9a5ea)" },
  ".comment": { color: "var(--soft)", fontStyle: "italic" },
  ".string": { color: "inherit" },
  ".mark": { color: "var(--soft)" },
  ".word-keyword, .word-direction, .word-directions, .word-kernel": { color: "light-dark(#1f5fbf, #7db3ff)" },
  ".word-function": { color: "light-dark(#8a5a00, #f0c060)" },
  ".word-element": { color: "light-dark(#1b6b3a, #7fd69b)" },
  ".word-field, .word-property": { color: "light-dark(#9c3b12, #ffab85)" },
  ".word-number": { color: "light-dark(#0f6674, #7ad3e0)" },
});

/** CodeMirror's icons for kinds of words. */
const ICONS = { element: "class", tag: "interface", field: "property", property: "property", parameter: "variable", function: "function", key: "type", pack: "namespace", value: "enum" };

/** The words of the loaded rules, and what each is. @type {Map<string, string>} */
let kinds = new Map();
const reworded = StateEffect.define();

const decorator = new MatchDecorator({
  regexp: /\d+(?:\.\d+)?%?|[A-Za-z_]\w*/g,
  decorate(add, from, to, match, view) {
    const line = view.state.doc.lineAt(from);
    const before = line.text.slice(0, from - line.from);
    if (/#/.test(before) && /(^|\s)#/.test(before)) return;
    if (/^\s*(-\s+)?about:/.test(line.text) || /about:\s*"?[^"]*$/.test(before)) return;
    const kind = /^\d/.test(match[0]) ? "number" : kinds.get(match[0]);
    if (!kind) return;
    if (line.text[to - line.from] === ":" && line.text[to - line.from + 1] !== "=") return;
    add(from, to, Decoration.mark({ class: `word-${kind}` }));
  },
});

const coloring = ViewPlugin.fromClass(
  class {
    constructor(view) {
      this.decorations = decorator.createDeco(view);
    }
    update(update) {
      const anew = update.transactions.some((one) => one.effects.some((effect) => effect.is(reworded)));
      this.decorations = anew ? decorator.createDeco(update.view) : decorator.updateDeco(update, this.decorations);
    }
  },
  { decorations: (plugin) => plugin.decorations },
);

/** A text and a place in it for Python, which counts code points. */
const place = (doc, at) => [doc.toString(), [...doc.sliceString(0, at)].length];

/** The words that fit at a place. Without an answer of the compiler there are none. */
async function complete(context) {
  const { state, pos, explicit } = context;
  const { from } = context.matchBefore(/\w*/);
  if (from === pos && !explicit) return null;
  const found = await compiler.call("complete", ...place(state.doc, pos)).catch(() => null);
  const options = found?.map(({ label, kind, about }) => ({ label, type: ICONS[kind] ?? "keyword", detail: kind, info: about || undefined }));
  return options ? { from, options, validFor: /^\w*$/ } : null;
}

/** What the word at a place means: Markdown with bold words, code and paragraphs only. */
async function explain({ state }, at) {
  const word = state.wordAt(at);
  if (!word) return null;
  const found = await compiler.call("explain", ...place(state.doc, word.from)).catch(() => "");
  const parts = found.split(/\*\*(.+?)\*\*|`(.+?)`/);
  const nodes = parts.map((text, index) => text && (index % 3 ? make(index % 3 === 1 ? "b" : "code", {}, text) : text));
  const create = () => ({ dom: make("div", { class: "about" }, ...nodes.filter(Boolean)) });
  return found ? { pos: word.from, end: word.to, above: true, create } : null;
}

/** Gives the file its one layout. The cursor stays behind as many characters that are not blank. */
async function format(view) {
  const before = view.state.doc.toString();
  const insert = await compiler.call("format", before).catch(() => before);
  if (insert === before || view.state.doc.toString() !== before) return;
  const solid = before.slice(0, view.state.selection.main.head).replace(/\s/g, "").length;
  const behind = [...insert.matchAll(/\S/g)][solid - 1]?.index + 1 || 0;
  view.dispatch({ changes: { from: 0, to: before.length, insert }, selection: { anchor: behind }, scrollIntoView: true });
}

export class Editor {
  /** @param {HTMLElement} parent @param {(text: string) => void} onChange */
  constructor(parent, onChange) {
    this.onChange = onChange;
    /** @type {Map<string, EditorState>} the state of each file: text, selection, its own undo */
    this.states = new Map();
    this.name = "";
    // In a shadow tree, CodeMirror's styles are adopted sheets, which the content security policy allows.
    const root = parent.attachShadow({ mode: "open" });
    this.view = new EditorView({ root, parent: root, state: this._state("") });
    this.view.dom.style.height = "100%";
  }

  _state(doc) {
    return EditorState.create({
      doc,
      extensions: [
        [lineNumbers(), lintGutter(), history(), drawSelection(), highlightActiveLine(), highlightActiveLineGutter()],
        [highlightSelectionMatches(), indentOnInput(), bracketMatching(), closeBrackets()],
        [autocompletion({ override: [complete] }), hoverTooltip(explain)],
        yaml(),
        syntaxHighlighting(STYLE),
        coloring,
        THEME,
        EditorView.contentAttributes.of({ tabindex: "0", "aria-label": "Rules. Escape, then Tab leaves the editor." }),
        // Escape, then Tab leaves the editor: CodeMirror's own way out for keyboards.
        keymap.of([{ key: "Shift-Alt-f", run: (view) => (format(view), true) }, ...completionKeymap, ...searchKeymap, ...historyKeymap, ...defaultKeymap, indentWithTab]),
        EditorView.updateListener.of((update) => {
          if (update.docChanged) this.onChange(this.name, update.state.doc.toString());
        }),
      ],
    });
  }

  /** @param {Record<string, string>} files */
  open(files) {
    this.states = new Map(Object.entries(files).map(([name, text]) => [name, this._state(text)]));
    this.name = "";
  }

  /** Another file, or another text of one. */
  add(name, text) {
    if (name === this.name) this.name = "";
    this.states.set(name, this._state(text));
  }

  /** The state of a file under another name. */
  rename(name, fresh) {
    this.states.set(fresh, name === this.name ? this.view.state : this.states.get(name));
    this.states.delete(name);
    if (name === this.name) this.name = fresh;
  }

  remove(name) {
    if (name === this.name) this.name = "";
    this.states.delete(name);
  }

  show(name) {
    if (this.name) this.states.set(this.name, this.view.state);
    this.name = name;
    this.view.setState(this.states.get(name));
  }

  /** Colors these words. @param {Record<string, string>} found  what each is */
  know(found) {
    kinds = new Map(Object.entries(found));
    this.view.dispatch({ effects: reworded.of(null) });
  }

  /** Marks diagnostics of the shown file. */
  mark(diagnostics) {
    const { doc } = this.view.state;
    const place = ({ line, column }) => {
      const found = doc.line(Math.min(Math.max(line, 1), doc.lines));
      return Math.min(found.from + column - 1, found.to);
    };
    const marks = diagnostics
      .filter((one) => one.primary.span?.file === this.name)
      .map(({ code, severity, message, primary, helps }) => {
        const from = place(primary.span.start);
        const to = Math.max(place(primary.span.end), Math.min(from + 1, doc.length));
        const level = severity === "note" ? "info" : severity;
        const text = [`${code}: ${message}`, primary.text, ...helps.map((one) => `help: ${one}`)];
        return { from, to, severity: level, message: text.filter(Boolean).join("\n") };
      });
    this.view.dispatch(setDiagnostics(this.view.state, marks));
  }

  goTo(line, column, { focus = true } = {}) {
    const found = this.view.state.doc.line(Math.min(line, this.view.state.doc.lines));
    const at = Math.min(found.from + column - 1, found.to);
    this.view.dispatch({ selection: { anchor: at }, effects: EditorView.scrollIntoView(at, { y: "center" }) });
    if (focus) this.view.focus();
  }
}
