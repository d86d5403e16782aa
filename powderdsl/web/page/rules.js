// The rules that people edit: files as tabs, checks while they type, and changes that the running world takes over.

import { Compiler } from "./compiler.js";
import { $, make, say } from "./dom.js";
import { Editor } from "./editor.js";
import { Engine } from "./engine.js";
import { refresh, use } from "./stage.js";
import { app } from "./state.js";
import { choose } from "./tools.js";

const PAUSE = 120; // ms without a key before a check
const packOf = (file) => file.replace(/\.ya?ml$/, "");

export const rules = (app.edits = {
  /** @type {Record<string, string>} */ files: {},
  /** @type {Set<string>} names of packs that are off */ off: new Set(),
  shown: "",
  /** @type {any[]} */ diagnostics: [],
  /** Whether the files differ from those of the site. */ edited: false,
  /** @type {Compiler} */ compiler: null,
  /** Functions that are called when other rules run. */ onApplied: [],
});

export const editor = new Editor($("editor"), (name, text) => {
  if (!name || rules.files[name] === text) return;
  rules.files[name] = text;
  edited();
});

rules.editor = editor;
rules.compiler = new Compiler((stage, error) => {
  $("compiler").textContent = `Compiler: ${stage}`;
  $("compiler").className = stage === "failed" ? "bad" : "";
  if (stage === "ready" && !app.compilerReady) app.compilerReady = performance.now();
  if (error) say(error, true);
});

/** Opens the files of the site, or those of a link. Resolves to what the check finds. */
export function openFiles(files, off = [], shown = undefined) {
  rules.files = { ...files };
  rules.off = new Set(off);
  rules.edited = false;
  rules.diagnostics = [];
  editor.open(rules.files);
  const names = Object.keys(files);
  const own = `${app.rules.key}.yaml`;
  const wanted = [shown, own].find((name) => name && names.includes(name) && !/^ruleset:/m.test(files[name]));
  show(wanted ?? names[2] ?? names.at(-1));
  return check({ applies: false });
}

function show(name) {
  rules.shown = name;
  editor.show(name);
  editor.mark(rules.diagnostics);
  showTabs();
}

function showTabs() {
  const bad = new Set(
    rules.diagnostics.filter((one) => one.severity === "error").map((one) => one.primary.span?.file),
  );
  const tabs = Object.entries(rules.files).map(([name, text]) => {
    const pack = packOf(name);
    const isRuleset = /^ruleset:/m.test(text);
    const classes = ["pack", name === rules.shown && "shown", bad.has(name) && "bad", rules.off.has(pack) && "off"];
    const attributes = { type: "checkbox", "aria-label": `${pack} takes part`, title: "Takes part" };
    const box = make("input", { ...attributes, onchange: () => toggle(pack) });
    box.checked = !rules.off.has(pack);
    const button = make("button", { type: "button", onclick: () => show(name) }, isRuleset ? name : pack);
    return make("span", { class: classes.filter(Boolean).join(" ") }, ...(isRuleset ? [] : [box]), button);
  });
  const add = make("button", { type: "button", title: "Add a pack of your own", onclick: addPack }, "+ pack");
  $("packs").replaceChildren(...tabs, add);
}

function toggle(pack) {
  if (rules.off.has(pack)) rules.off.delete(pack);
  else rules.off.add(pack);
  edited();
  showTabs();
}

/** A pack with an element that falls, where the rules have gravity. */
const NEW = (name) => `pack: ${name}
about: An element of my own.
${"core.yaml" in rules.files ? "needs: core\n" : ""}elements:
  ${name}:
    color: "#E0559A"
${"core.yaml" in rules.files ? FALLING : ""}`;

const FALLING = `    density: 4
    gravity: yes
    tags: powder
`;

/** Adds a file, and shows it. */
export function addFile(name, text) {
  rules.files[name] = text;
  editor.add(name, text);
  edited();
  show(name);
}

function addPack() {
  const names = new Set(Object.keys(rules.files));
  const number = [1, 2, 3, 4, 5, 6, 7, 8, 9].find((n) => !names.has(`mine${n > 1 ? n : ""}.yaml`)) ?? 1;
  const name = `mine${number > 1 ? number : ""}`;
  addFile(`${name}.yaml`, NEW(name));
}

let waiting = null;
function edited() {
  rules.edited = true;
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
      showProblem(String(error.message ?? error));
    }
  }
  return found;
}

async function checkNow(applies) {
  const began = rules.changedAt;
  const found = await rules.compiler.check(rules.files, [...rules.off]);
  rules.diagnostics = found.diagnostics;
  rules.checkTook = performance.now() - began;
  if (found.words) editor.know(found.words);
  editor.mark(found.diagnostics);
  showTabs();
  showProblems(found.ok);
  if (again || !found.ok || !applies) return found;
  await applyRules();
  rules.applyTook = performance.now() - began;
  return found;
}

/** Compiles the checked files for a size, the present one by default, and continues the world under them. */
export async function applyRules(rows = app.engine.rows, columns = app.engine.columns) {
  const module = await compiled(rows, columns);
  const engine = await Engine.start(module);
  const lost = continueUnder(engine);
  app.compiled = compiled;
  for (const one of rules.onApplied) one();
  const words = lost.length ? `; without ${lost.slice(0, 5).join(", ")}` : "";
  say(`The new rules run${words}.`);
}

async function compiled(rows, columns) {
  return WebAssembly.compile(await rules.compiler.call("compile", rows, columns));
}

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

function showProblem(text) {
  $("problems").replaceChildren(make("div", { class: "problem" }, make("pre", {}, text)));
}

function showProblems(ok) {
  const listed = rules.diagnostics.filter((one) => one.severity !== "note");
  const shown = listed.slice(0, 40).map((one) => {
    const { span } = one.primary;
    const go = () => {
      if (!span || !(span.file in rules.files)) return;
      show(span.file);
      editor.goTo(span.start.line, span.start.column);
    };
    const text = one.text.replace(/\n *= more: .*$/, "");
    const keys = ({ key }) => key === "Enter" && go();
    const attributes = { class: `problem ${one.severity}`, tabindex: "0", onclick: go, onkeydown: keys };
    return make("div", { ...attributes, title: "Enter or a click goes to the place" }, make("pre", {}, text));
  });
  if (listed.length > shown.length) shown.push(make("p", { class: "soft" }, `and ${listed.length - shown.length} more`));
  if (!ok && rules.edited) shown.push(make("p", { class: "soft" }, "The last good rules keep running."));
  if (!shown.length) shown.push(make("p", { class: "good" }, "No mistakes."));
  $("problems").replaceChildren(...shown);
}

app.onRules.push((sheet) => openFiles(sheet.files, sheet.off));
if (app.rules) openFiles(app.rules.files, app.rules.off);
