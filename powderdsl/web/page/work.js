// What the page shows as one value, a moment: swaps of the engine put moments in place, and undo returns to them.

import { $, failed, fill } from "./dom.js";
import { Engine } from "./engine.js";
import { clearChart } from "./readings.js";
import { listedRules, moduleOf, sizesOf } from "./shipped.js";
import { refresh, use } from "./stage.js";
import { app } from "./state.js";

/**
 * What `moment` makes. Moments of one `sitting` have the same rules, as edited since; `work` is a name in the browser's
 * storage. `texts` are the files that change, where nothing else does: those are exchanged alone.
 * @typedef {ReturnType<typeof moment> & {texts?: Record<string, string | undefined>}} Moment
 */

/** The entry of the menu of rules that asks for a seed. */
export const UNIVERSE = "universe…";

let newest = 0;
let supersede = () => {};

/**
 * Puts another engine in place: `prepare` resolves to a function that does it at once. What began before a newer swap
 * never lands, and its failure is ignored. Resolves to whether it has landed.
 * @param {() => Promise<() => void>} prepare
 */
export function swap(prepare) {
  const mine = ++newest;
  supersede();
  const superseded = new Promise((resolve) => (supersede = resolve));
  const run = async () => {
    try {
      const land = await Promise.race([prepare(), superseded]);
      if (mine !== newest) return false;
      land();
      return true;
    } catch (error) {
      if (mine === newest) throw error;
      return false;
    } finally {
      if (mine === newest) [(app.swapping = null), showMenus()];
    }
  };
  const landed = run();
  app.swapping = landed.catch(() => {});
  return landed;
}

/** The menus say what runs, whatever was chosen. */
export function showMenus() {
  const { engine, named, rules } = app;
  if (!engine) return;
  const listed = listedRules(rules.key);
  const keys = app.catalog.rules.map((one) => one.key);
  const edited = app.edits?.edited ?? app.opened?.edited;
  const label = (key) => (key === rules.key && edited ? `${key} (edited)` : key);
  const rows = (listed ? keys : [...keys, rules.key]).map((key) => [key, label(key)]);
  fill($("rules"), [...rows, [UNIVERSE, UNIVERSE]], rules.key);
  const size = `${engine.rows}x${engine.columns}`;
  const sizes = new Set([...sizesOf(rules.key).map((one) => one.join("x")), size]);
  fill($("size"), [...sizes].map((one) => [one, one.replace("x", "×")]), size);
  const worlds = rules.worlds.map((one) => [one.name, one.name.replace(/^task /, "task: ")]);
  const opened = named.world ? [] : [["", "opened world"]];
  fill($("world"), [...opened, ...worlds, ["random", "random shapes"], ["empty", "empty"]], named.world);
  $("seed").value = named.seed;
}

/** Parameters whose values are not those of the files. */
export const changedParameters = ({ parameters, values } = app.engine) =>
  Object.fromEntries(parameters.flatMap((one, i) => (values[i] === one.value ? [] : [[one.name, values[i]]])));

function setParameters(engine, values) {
  engine.parameters.forEach((one, i) => {
    const value = Object.hasOwn(values, one.name) ? values[one.name] : one.value;
    if (value !== engine.values[i]) engine.setParameter(i, value);
  });
}

export function moment() {
  const { compiled, engine, named, painted, sitting, start, work } = app;
  const edits = app.edits ? app.edits.moment() : app.opened;
  const parameters = changedParameters();
  const world = engine.snapshot();
  return { sitting, work, sheet: app.rules, module: engine.module, compiled, edits, parameters, world, start, named, painted };
}

/** Whether the user has done something that a fresh start would lose. */
export const isWork = () =>
  app.painted || Boolean(app.edits?.edited ?? app.opened?.edited) || Object.keys(changedParameters()).length > 0;

/** Keeps the present moment, before a change, so that it can be undone. @param {string[]} [names]  of files that change */
export function remember(names) {
  const found = moment();
  app.history.keep(names ? { ...found, texts: textsOf(names, found.edits) } : found);
  app.checkpoints = [];
  app.unsaved = true;
}

const textsOf = (names, { files }) => Object.fromEntries(names.map((name) => [name, files[name]]));

/** The bytes of modules that were compiled here. @type {WeakMap<WebAssembly.Module, Uint8Array>} */
export const bytesOf = new WeakMap();

let sittings = 0;
export const newSitting = () => ++sittings;
export const newWork = () => `${Date.now().toString(36)}-${Math.random().toString(36).slice(2, 10)}`;

/** Opens a moment, with an engine of its rules and size. Resolves to the names that its rules lack. @param {Moment} found */
export function open(found, engine) {
  const { compiled, sheet, sitting, work } = found;
  Object.assign(app, { rules: sheet, compiled, opened: found.edits, sitting, work, keepParameters: false });
  setParameters(engine, found.parameters);
  use(engine);
  clearChart();
  const lost = show(found);
  for (const one of app.onRules) one(sheet, found.edits);
  return lost;
}

/** Shows the world of a moment of the same rules. */
function show({ world, start, named, painted, parameters }) {
  const lost = app.engine.restore(world);
  Object.assign(app, { start, named, painted, checkpoints: [], unsaved: true });
  if (JSON.stringify(changedParameters()) !== JSON.stringify(parameters)) {
    setParameters(app.engine, parameters);
    for (const one of app.onEngine) one(app.engine);
  }
  showMenus();
  refresh();
  return lost;
}

/** Undoes the last change, or does it again. @param {"undo" | "redo"} way */
async function travel(way) {
  const entry = app.history.next(way);
  if (!entry) return;
  const exchange = (act) => {
    const present = moment();
    if (entry.texts) present.texts = textsOf(Object.keys(entry.texts), present.edits);
    app.history.go(way, present);
    act();
    refresh();
  };
  const { rows, columns } = entry.world;
  if (entry.sitting !== app.sitting) {
    await swap(async () => {
      const engine = await Engine.start(entry.module);
      return () => exchange(() => open(entry, engine));
    });
  } else if (entry.texts) exchange(() => app.edits.exchange(entry.texts, entry.edits));
  else if (rows === app.engine.rows && columns === app.engine.columns) exchange(() => show(entry));
  else {
    await swap(async () => {
      const engine = await Engine.start(await moduleOf(rows, columns));
      return () => exchange(() => [use(engine), show(entry)]);
    });
  }
}

/** One after the other: the second of two quick ones waits for the engine of the first. */
let traveling = Promise.resolve();
const queued = (way) => (traveling = traveling.then(() => travel(way)).catch(failed));
export const undo = () => queued("undo");
export const redo = () => queued("redo");
