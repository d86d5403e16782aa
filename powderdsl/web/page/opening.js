// Rules and worlds of the site: fetches, opens and resizes them.

import { $, failed, fill, get, say } from "./dom.js";
import { Engine, enlarged, framed, scatter, tiled } from "./engine.js";
import { clearChart } from "./readings.js";
import { refresh, setRunning, use } from "./stage.js";
import { app } from "./state.js";
import { remember } from "./tools.js";
import { readWorld } from "./worlds.js";

const modules = new Map();

/** The site's module of its own rules. */
export function shippedModule(key, rows, columns) {
  const path = `rules/${key}-${rows}x${columns}.wasm`;
  if (!modules.has(path)) {
    const found = get(path).then(async (answer) => WebAssembly.compile(await answer.arrayBuffer()));
    found.catch(() => modules.delete(path));
    modules.set(path, found);
  }
  return modules.get(path);
}

const sheets = new Map();
export function sheetOf(key) {
  if (!sheets.has(key)) sheets.set(key, get(`rules/${key}.json`).then((answer) => answer.json()));
  return sheets.get(key);
}

const moduleOf = (rows, columns) =>
  app.compiled ? app.compiled(rows, columns) : shippedModule(app.rules.key, rows, columns);

export const size = () => $("size").value.split("x").map(Number);

let openings = 0;

/** Opens rules of the site. Resolves to whether they are open. */
export async function openRules(key, { world, size: wanted = "64x64", run = true } = {}) {
  say(`Loading ${key}…`);
  const mine = ++openings;
  const listed = app.catalog.rules.find((one) => one.key === key);
  const shape = listed.sizes.some((one) => one.join("x") === wanted) ? wanted : listed.sizes[0].join("x");
  const [sheet, module] = await Promise.all([sheetOf(key), shippedModule(key, ...shape.split("x"))]);
  const engine = await Engine.start(module);
  if (mine !== openings) return false; // others were chosen meanwhile
  // Packs are opened to paint with their own elements, the first of which is the ground in rules of one pack.
  const own = engine.elements.find((one) => one.qualified.startsWith(`${key}.`) && one.id !== engine.ground);
  if (own) app.element = own.qualified;
  app.rules = sheet;
  app.compiled = null;
  $("rules").value = key;
  fill($("size"), listed.sizes.map((one) => [one.join("x"), one.join("×")]), shape);
  fillWorlds(world ?? sheet.shown);
  app.keepParameters = false;
  use(engine);
  startWorld();
  setRunning(run);
  say(sheet.about || sheet.title);
  for (const one of app.onRules) one(sheet);
  return true;
}

function fillWorlds(chosen) {
  const names = app.rules.worlds.map((one) => [one.name, one.name.replace(/^task /, "task: ")]);
  fill($("world"), [...names, ["random", "random shapes"], ["empty", "empty"]], chosen ?? "random");
}

/** Opens other rules, unless the user wants to keep edits. */
export function chooseRules(key) {
  if (app.edits?.edited && !confirm("Open other rules, and lose your edits of these?")) {
    $("rules").value = app.rules.key;
    return;
  }
  openRules(key, { size: $("size").value }).catch(failed);
}

/** Worlds of tasks, which come after the first world runs. @param {Record<string, any[]>} found  by rules */
export async function addWorlds(found) {
  for (const [key, worlds] of Object.entries(found)) {
    if (!app.catalog.rules.some((one) => one.key === key)) continue;
    const sheet = await sheetOf(key);
    sheet.worlds.push(...worlds);
    if (app.rules === sheet) fillWorlds($("world").value);
  }
}

/** Begins the chosen world, with the chosen seed. */
export function startWorld() {
  const { engine } = app;
  const seed = Number($("seed").value) >>> 0;
  const name = $("world").value;
  const listed = app.rules.worlds.find((one) => one.name === name);
  if (listed) {
    const world = readWorld(listed);
    engine.restore(filling(world, engine));
    if (!world.clock.some(Boolean)) engine.reseed(seed);
  } else if (name === "empty") {
    engine.begin(framed(new Uint8Array(engine.cells).fill(engine.ground), engine, app.rules.frame), seed);
  } else {
    engine.begin(scatter(engine, app.rules.frame, seed), seed);
  }
  app.start = engine.snapshot();
  app.history.clear();
  app.checkpoints = [];
  clearChart();
  refresh();
}

/** A start world that fills a larger one: patterns of cellular automata are repeated, where things move they grow. */
function filling(world, { rows, columns }) {
  const [down, right] = [Math.floor(rows / world.rows), Math.floor(columns / world.columns)];
  const factor = Math.min(down, right);
  if (factor < 1 || down * right === 1) return world;
  return app.rules.frame === null ? tiled(world, down, right) : enlarged(world, factor);
}

/** Continues with a world from elsewhere, which `reset` returns to. @param {import("./engine.js").Snapshot} world */
export function openWorld(world) {
  remember();
  const lost = app.engine.restore(world);
  app.start = app.engine.snapshot();
  refresh();
  return lost;
}

export async function resize() {
  const before = app.engine.snapshot();
  const [rows, columns] = size();
  say("Loading…");
  try {
    const module = await moduleOf(rows, columns);
    app.keepParameters = true;
    use(await Engine.start(module));
  } catch (error) {
    say(String(error.message ?? error), true);
    $("size").value = `${before.rows}x${before.columns}`;
    return;
  }
  if (["random", "empty"].includes($("world").value) || app.rules.worlds.some((one) => one.name === $("world").value))
    startWorld();
  say(`${rows}×${columns} cells`);
}
