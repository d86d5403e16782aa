// The editor of rule files: CodeMirror with YAML, colors for the line language, completion and diagnostics.

import { autocompletion, closeBrackets, completionKeymap } from "@codemirror/autocomplete";
import { defaultKeymap, history, historyKeymap, indentWithTab } from "@codemirror/commands";
import { yaml } from "@codemirror/lang-yaml";
import { HighlightStyle, bracketMatching, indentOnInput, syntaxHighlighting } from "@codemirror/language";
import { lintGutter, setDiagnostics } from "@codemirror/lint";
import { highlightSelectionMatches, searchKeymap } from "@codemirror/search";
import { EditorState, StateEffect } from "@codemirror/state";
import { Decoration, EditorView, MatchDecorator, ViewPlugin, drawSelection, keymap, lineNumbers } from "@codemirror/view";
import { highlightActiveLine, highlightActiveLineGutter } from "@codemirror/view";
import { tags } from "@lezer/highlight";

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
  ".key": { color: "light-dark(#7a2e8e, #d9a5ea)" },
  ".comment": { color: "var(--soft)", fontStyle: "italic" },
  ".string": { color: "inherit" },
  ".mark": { color: "var(--soft)" },
  ".word-keyword": { color: "light-dark(#1f5fbf, #7db3ff)" },
  ".word-function": { color: "light-dark(#8a5a00, #f0c060)" },
  ".word-element": { color: "light-dark(#1b6b3a, #7fd69b)" },
  ".word-field": { color: "light-dark(#9c3b12, #ffab85)" },
  ".word-number": { color: "light-dark(#0f6674, #7ad3e0)" },
});

const KINDS = ["keyword", "function", "element", "field", "parameter"];
const TYPES = { element: "class", field: "property", parameter: "variable", function: "function", keyword: "keyword", key: "type" };

/** The words of the rules that are loaded, by kind; `kinds` says what a word is. */
let words = { key: [] };
let kinds = new Map();
const reworded = StateEffect.define();

function setWords(found) {
  words = found;
  kinds = new Map();
  for (const kind of [...KINDS].reverse()) for (const word of found[kind] ?? []) kinds.set(word, kind);
}

const decorator = new MatchDecorator({
  regexp: /\d+(?:\.\d+)?%?|[A-Za-z_]\w*/g,
  decorate(add, from, to, match, view) {
    const line = view.state.doc.lineAt(from);
    const before = line.text.slice(0, from - line.from);
    if (/#/.test(before) && /(^|\s)#/.test(before)) return;
    if (/^\s*(-\s+)?about:/.test(line.text) || /about:\s*"?[^"]*$/.test(before)) return;
    const kind = /^\d/.test(match[0]) ? "number" : kinds.get(match[0]);
    if (!kind || kind === "parameter") return;
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

/** Keys where a line begins, otherwise the words of the line language and the loaded names. */
function complete(context) {
  const found = context.matchBefore(/[A-Za-z_]\w*/);
  if (!found && !context.explicit) return null;
  const from = found?.from ?? context.pos;
  const before = context.state.doc.lineAt(from).text.slice(0, from - context.state.doc.lineAt(from).from);
  const atKey = /^\s*$/.test(before) || /[{,]\s*$/.test(before);
  const options = [];
  for (const kind of atKey ? ["key", ...KINDS] : KINDS)
    for (const word of words[kind] ?? []) options.push({ label: word, type: TYPES[kind], detail: kind });
  return { from, options, validFor: /^\w*$/ };
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
        autocompletion({ override: [complete] }),
        yaml(),
        syntaxHighlighting(STYLE),
        coloring,
        THEME,
        EditorView.contentAttributes.of({ tabindex: "0", "aria-label": "Rules. Escape, then Tab leaves the editor." }),
        // Escape, then Tab leaves the editor: CodeMirror's own way out for keyboards.
        keymap.of([...completionKeymap, ...searchKeymap, ...historyKeymap, ...defaultKeymap, indentWithTab]),
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

  /** Colors and completes these words. @param {Record<string, string[]>} found  by kind */
  know(found) {
    setWords(found);
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

  goTo(line, column) {
    const found = this.view.state.doc.line(Math.min(line, this.view.state.doc.lines));
    const at = Math.min(found.from + column - 1, found.to);
    this.view.dispatch({ selection: { anchor: at }, effects: EditorView.scrollIntoView(at, { y: "center" }) });
    this.view.focus();
  }
}
