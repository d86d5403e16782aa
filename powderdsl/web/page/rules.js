// The rules that people edit: files as tabs, checks while they type, and changes that the running world takes over.

import { compiler } from "./compiler.js";
import { $, make, say } from "./dom.js";
import { Editor } from "./editor.js";
import { Engine } from "./engine.js";
import { refresh, use } from "./stage.js";
import { app } from "./state.js";
import { showPanel } from "./tabs.js";
import { choose } from "./tools.js";
import { bytesOf, remember, showMenus, swap } from "./work.js";

const PAUSE = 120; // ms without a key before a check
export const packOf = (file) => file.replace(/\.ya?ml$/, "");
export const isRuleset = (text) => /^ruleset:/m.test(text);

/** The lines of a file with their numbers and the key of the top level that they belong to. */
export function* linesOf(source) {
  let section = "";
  for (const [at, text] of source.split("\n").entries()) {
    section = /^(\w+):/.exec(text)?.[1] ?? section;
    if (!/^\s*(#|about:|$)/.test(text)) yield { line: at + 1, text, section };
  }
}

/** The first rule of a file: something that becomes something else. */
const firstRule = (text) => [...linesOf(text)].find((one) => one.section === "passes" && one.text.includes(" -> "));
const declared = (text) => /^pack: *([A-Za-z_]\w{0,60}) *(#.*)?$/m.exec(text)?.[1];

/** Whether the same packs of the same files take part. */
const alike = (a, b) =>
  String(a.off) === String(b.off) &&
  Object.keys(a.files).length === Object.keys(b.files).length &&
  Object.keys(a.files).every((name) => a.files[name] === b.files[name]);

export const rules = (app.edits = {
  /** @type {Record<string, string>} */ files: {},
  /** @type {Set<string>} names of packs that are off */ off: new Set(),
  shown: "",
  /** The files that run: the last ones without mistakes. @type {{files: Record<string, string>, off: string[]}} */
  good: null,
  /** The pack that each file declares, as far as tabs know. @type {Record<string, string | undefined>} */ packs: {},
  /** @type {any[]} */ diagnostics: [],
  /** Whether the files differ from those of the site. */
  get edited() {
    return !alike(app.rules, { files: rules.files, off: [...rules.off] });
  },
  moment: () => ({ files: { ...rules.files }, off: [...rules.off], good: rules.good, shown: rules.shown, edited: rules.edited }),
  exchange,
  recheck,
  compiler: null,
  /** Functions that are called when other rules run. */ onApplied: [],
});

export const editor = new Editor($("editor"), (name, text) => {
  if (!name || rules.files[name] === text) return;
  rules.files[name] = text;
  edited();
});

rules.editor = editor;
rules.compiler = compiler;

/** Opens files, of which `good` run. Resolves to what the check finds. */
export function openFiles({ files, off = [], shown, good }) {
  clearTimeout(waiting);
  rules.files = { ...files };
  rules.off = new Set(off);
  rules.good = good ?? { files, off };
  rules.diagnostics = [];
  rules.packs = Object.fromEntries(Object.entries(files).map(([name, text]) => [name, declared(text)]));
  editor.open(rules.files);
  const names = Object.keys(files);
  const own = `${app.rules.key}.yaml`;
  const wanted = shown in files ? shown : names.includes(own) && !isRuleset(files[own]) ? own : null;
  show(wanted ?? names.find((name) => !isRuleset(files[name]) && firstRule(files[name])) ?? names.at(-1));
  const rule = shown in files ? null : firstRule(files[rules.shown]);
  if (rule) editor.goTo(rule.line, rule.text.indexOf(" -> ") + 5, { focus: false });
  return recheck();
}

/** Has the compiler hold the files that run, whatever it was asked about meanwhile, and looks for mistakes again. */
function recheck() {
  const { files, off } = rules.good;
  if (!alike(rules.good, { files: rules.files, off: [...rules.off] })) rules.compiler.check(files, off).catch(() => {});
  return check({ applies: false });
}

function show(name) {
  if (!(name in rules.files)) return; // a tab that waits for a name to be typed
  rules.shown = name;
  editor.show(name);
  editor.mark(rules.diagnostics);
  showTabs();
}

function showTabs() {
  if (rules.naming) return; // a name is being typed
  const bad = new Set(rules.diagnostics.filter((one) => one.severity === "error").map((one) => one.primary.span?.file));
  const tabs = Object.entries(rules.files).map(([name, text]) => {
    const pack = packOf(name);
    const classes = ["pack", name === rules.shown && "shown", bad.has(name) && "bad", rules.off.has(pack) && "off"];
    const attributes = { type: "checkbox", "aria-label": `${pack} takes part`, title: "Takes part" };
    const box = make("input", { ...attributes, onchange: () => toggle(pack) });
    box.checked = !rules.off.has(pack);
    const label = isRuleset(text) ? name : pack;
    const keys = ({ key }) => (key === "F2" ? askName(name) : key === "Delete" && removeFile(name));
    const pressed = String(name === rules.shown);
    const button = make("button", { type: "button", "aria-pressed": pressed, onclick: () => show(name), onkeydown: keys }, label);
    return make("span", { class: classes.filter(Boolean).join(" ") }, ...(isRuleset(text) ? [] : [make("label", {}, box)]), button);
  });
  const one = rules.shown;
  const act = (label, title, onclick) => make("button", { type: "button", class: "small", title, "aria-label": title, onclick }, label);
  const acts = [
    act("Rename", `Rename ${one} (F2)`, () => askName(one)),
    act("Duplicate", `Duplicate ${one}`, () => duplicate(one)),
    act("Delete", `Delete ${one} (Delete)`, () => removeFile(one)),
  ];
  const add = make("button", { type: "button", title: "Add a pack of your own", onclick: () => addPack() }, "+ pack");
  const focused = [...$("packs").querySelectorAll("button, input")].indexOf(document.activeElement);
  $("packs").replaceChildren(...tabs, add, make("span", { class: "row" }, ...acts));
  if (focused >= 0) [...$("packs").querySelectorAll("button, input")].at(focused)?.focus();
}

/** Puts a field for another name in the place of a tab. */
function askName(name) {
  if (rules.naming) return;
  const at = Object.keys(rules.files).indexOf(name);
  const field = make("input", { "aria-label": `Another name for ${packOf(name)}`, size: 12, maxlength: 60 });
  field.value = packOf(name);
  field.onkeydown = ({ key }) => {
    if (key === "Escape") field.value = packOf(name);
    if (key === "Escape" || key === "Enter") field.blur();
  };
  field.onblur = () => {
    rules.naming = false;
    const pack = field.value.trim();
    if (pack !== packOf(name) && name in rules.files) renameFile(name, pack);
    showTabs();
    $("packs").children[at]?.querySelector("button")?.focus();
  };
  rules.naming = true;
  $("packs").children[at].querySelector("button").replaceWith(field);
  field.select();
}

const withName = (text, pack) => text.replace(/^(pack|ruleset): *\w+/m, `$1: ${pack}`);

/** Renames a file, and the pack or ruleset that it declares. */
function renameFile(name, pack) {
  const fresh = `${pack}.yaml`;
  if (!/^[A-Za-z_]\w{0,59}$/.test(pack)) return say(`“${pack}” is no name: letters, digits and _, no digit first`, true);
  if (fresh in rules.files) return say(`There is a ${fresh} already.`, true);
  remember([name, fresh]);
  move(name, fresh);
  exchange({ [fresh]: withName(rules.files[fresh], pack) });
}

/** Gives a file another name; its place and the editor's undo stay. */
function move(name, fresh) {
  rules.files = Object.fromEntries(Object.entries(rules.files).map(([one, text]) => [one === name ? fresh : one, text]));
  rules.packs[fresh] = rules.packs[name];
  if (rules.off.delete(packOf(name))) rules.off.add(packOf(fresh));
  if (rules.shown === name) rules.shown = fresh;
  editor.rename(name, fresh);
}

/** A pack that another name is typed for gets a file of that name, if there is none. */
function followNames() {
  for (const [name, text] of Object.entries(rules.files)) {
    const [before, now] = [rules.packs[name], declared(text)];
    if (!now || now === before) continue;
    rules.packs[name] = now;
    if (before === packOf(name) && !(`${now}.yaml` in rules.files)) move(name, `${now}.yaml`);
  }
}

/** A name like `pack` that no file has. */
function freeName(pack, number = 1) {
  const name = number > 1 ? `${pack}${number}` : pack;
  return `${name}.yaml` in rules.files ? freeName(pack, number + 1) : name;
}

function duplicate(name) {
  const pack = freeName(packOf(name).replace(/\d+$/, ""));
  addFile(`${pack}.yaml`, withName(rules.files[name], pack));
}

const undoButton = () => make("button", { type: "button", class: "small", onclick: () => $("undo").click() }, "Undo");

function removeFile(name) {
  if (Object.keys(rules.files).length === 1) return say("This is the only file: rules need one.", true);
  remember([name]);
  exchange({ [name]: undefined });
  say(`${name} is deleted. `, false, undoButton());
}

/** Replaces the texts of some files, or deletes them; `like` has their order, and the packs that are off. */
function exchange(texts, like = rules.moment()) {
  const all = { ...like.files, ...rules.files, ...texts };
  const kept = Object.keys(all).filter((name) => (name in texts ? texts : rules.files)[name] !== undefined);
  if (!kept.length) return; // rules need a file
  rules.files = Object.fromEntries(kept.map((name) => [name, all[name]]));
  rules.off = new Set(like.off);
  for (const [name, text] of Object.entries(texts)) {
    rules.packs[name] = text && declared(text);
    if (text === undefined) editor.remove(name);
    else editor.add(name, text);
  }
  show([like.shown, rules.shown].find((name) => kept.includes(name)) ?? kept.at(-1));
  edited();
}

function toggle(pack) {
  remember([]);
  if (!rules.off.delete(pack)) rules.off.add(pack);
  edited();
  showTabs();
}

/** A pack with an element that falls, where the rules have gravity. */
const NEW = (name) => `pack: ${name}
about: An element of my own.
${"core.yaml" in rules.files ? "needs: core\n" : ""}elements:
  ${name}:
    color: "#E0559A"
${"core.yaml" in rules.files ? "    density: 4\n    gravity: yes\n    tags: powder\n" : ""}`;
/** Adds a file, and shows it; one of that name is replaced. */
export function addFile(name, text) {
  const replaced = name in rules.files;
  if (rules.files[name] === text) return show(name);
  remember([name]);
  exchange({ [name]: text });
  show(name);
  if (replaced) say(`${name} is replaced. `, false, undoButton());
}

/** Opens a ruleset with the files that come with it, and those of the present packs that it names. */
export function addRuleset(files) {
  const text = Object.values(files).find(isRuleset);
  const isNamed = (name) => !isRuleset(rules.files[name]) && new RegExp(`\\b${packOf(name)}\\b`).test(text);
  const gone = Object.keys(rules.files).filter((name) => !isNamed(name));
  remember([...gone, ...Object.keys(files)]);
  exchange({ ...Object.fromEntries(gone.map((name) => [name, undefined])), ...files }, { ...rules.moment(), off: [] });
  show(Object.keys(files).find((name) => isRuleset(files[name])));
}

function addPack(wanted = "mine") {
  const name = freeName(wanted);
  addFile(`${name}.yaml`, NEW(name));
}

let waiting = null;
function edited() {
  app.unsaved = true;
  [rules.changedAt, rules.checkTook, rules.applyTook] = [performance.now(), null, null];
  clearTimeout(waiting);
  waiting = setTimeout(() => check({ applies: true }), PAUSE);
}

/** The check that runs, and whether another one has to follow, for files that have changed since. */
let running = null;
let again = false;
let applying = false;

/**
 * Checks the files; if `applies` and they have no mistakes, the world continues under them. One check runs at a time.
 * @returns {Promise<{ok: boolean} | undefined>} what the last check found
 */
async function check({ applies }) {
  applying = applies;
  again = true;
  running ??= checkAll().finally(() => (running = null));
  return running;
}

async function checkAll() {
  let found;
  while (again) {
    again = false;
    try {
      found = await checkNow(applying);
    } catch (error) {
      found = undefined;
      rules.checkTook = performance.now() - rules.changedAt;
      say(String(error.message ?? error), true);
      $("problems").replaceChildren(make("div", { class: "problem" }, make("pre", {}, String(error.message ?? error))));
    }
  }
  return found;
}

async function checkNow(applies) {
  const began = rules.changedAt;
  const { sitting } = app;
  if (applies) followNames();
  const [files, off] = [{ ...rules.files }, [...rules.off]];
  const found = await rules.compiler.check(files, off);
  if (sitting !== app.sitting) return found; // others were opened meanwhile
  if (found.ok && alike(rules.good, { files, off })) rules.good = { files, off };
  rules.diagnostics = found.diagnostics;
  if (began === rules.changedAt) rules.checkTook = performance.now() - began; // else another check follows
  for (const [name, text] of Object.entries(found.texts)) {
    if (name in rules.files) continue;
    [rules.files[name], rules.packs[name]] = [text, declared(text)]; // it ships, and the rules use it
    editor.add(name, text);
  }
  if (found.words) editor.know(found.words);
  editor.mark(found.diagnostics);
  showTabs();
  showMenus();
  showProblems(found.ok);
  while (app.swapping) await app.swapping;
  if (again || !found.ok || !applies || sitting !== app.sitting) return found;
  const applied = await applyRules({ files, off });
  // Another size was chosen meanwhile: the rules have to be compiled for it.
  if (!applied && sitting === app.sitting) again = true;
  if (began === rules.changedAt) rules.applyTook = performance.now() - began;
  return found;
}

/** Compiles checked files, and continues the world under them. Resolves to whether they run. */
async function applyRules(good) {
  const { rows, columns } = app.engine;
  return swap(async () => {
    const engine = await Engine.start(await compile(good, rows, columns));
    return () => {
      const lost = continueUnder(engine);
      app.compiled = true;
      rules.good = good;
      for (const one of rules.onApplied) one();
      const words = lost.length ? `; without ${lost.slice(0, 5).join(", ")}` : "";
      say(`The new rules run${words}.`);
    };
  });
}

/** A module of some files; null if they have mistakes. */
export async function compile({ files, off }, rows, columns) {
  const { compiler } = rules;
  // Both requests leave together, so that no other check comes between them.
  const checking = compiler.holds === files ? { ok: true } : compiler.check(files, off);
  const compiling = compiler.call("compile", rows, columns);
  compiling.catch(() => {});
  if (!(await checking).ok) return null;
  const bytes = await compiling;
  const module = await WebAssembly.compile(bytes);
  bytesOf.set(module, bytes);
  return module;
}

/** A module of the rules that run. */
export const compiled = (rows, columns) => compile(rules.good, rows, columns);

function continueUnder(engine) {
  const before = app.engine.snapshot();
  const known = new Set(app.engine.elements.map((one) => one.qualified));
  const start = app.start;
  app.keepParameters = true;
  use(engine);
  choose(engine.elements.find((one) => !known.has(one.qualified))); // a new element waits to be painted
  app.start = start;
  const lost = engine.restore(before);
  refresh();
  return lost;
}

/** Shows a place of a file in the editor. */
export function goTo(file, line, column) {
  if (!(file in rules.files)) return;
  showPanel("rules-panel");
  show(file);
  editor.goTo(line, column);
}

function showProblems(ok) {
  const listed = rules.diagnostics.filter((one) => one.severity !== "note");
  const shown = listed.slice(0, 40).map((one) => {
    const { span } = one.primary;
    const go = () => span && goTo(span.file, span.start.line, span.start.column);
    const text = one.text.replace(/\n *= more: .*$/, "");
    const keys = ({ key }) => key === "Enter" && go();
    const attributes = { class: `problem ${one.severity}`, tabindex: "0", onclick: go, onkeydown: keys };
    return make("div", { ...attributes, title: "Enter or a click goes to the place" }, make("pre", {}, text));
  });
  if (listed.length > shown.length) shown.push(make("p", { class: "soft" }, `and ${listed.length - shown.length} more`));
  const missing = listed.map((one) => /^no pack or ruleset `(\w+)`/.exec(one.message)?.[1]).filter((one) => one && !(`${one}.yaml` in rules.files));
  if (missing.length) {
    const adds = [...new Set(missing)].map((one) => make("button", { type: "button", class: "small", onclick: () => addPack(one) }, `Add ${one}`));
    shown.unshift(make("p", {}, `Packs are missing: ${[...new Set(missing)].join(", ")}. Drop their files on the page, or `, ...adds, " as new ones."));
  }
  if (!ok && rules.edited) shown.push(make("p", { class: "soft" }, "The last good rules keep running."));
  if (!shown.length) shown.push(make("p", { class: "good" }, "No mistakes."));
  $("problems").replaceChildren(...shown);
}

app.onRules.push((sheet, edits) => openFiles(edits ?? sheet));
if (app.rules) openFiles(app.opened ?? app.rules);
