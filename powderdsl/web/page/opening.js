// Worlds and rules that are opened: those of the site, of links and files, other sizes.

import { $, failed, say } from "./dom.js";
import { Engine, enlarged, framed, scatter, tiled } from "./engine.js";
import { clearChart } from "./readings.js";
import { hasModule, isUniverse, listedRules, moduleOf, sheetOf, shippedModule, sizesOf, unedited } from "./shipped.js";
import { refresh, setRunning, use } from "./stage.js";
import { app } from "./state.js";
import { UNIVERSE, isWork, newSitting, newWork, open, remember, showMenus, swap } from "./work.js";
import { MAX_CLOCK, readWorld } from "./worlds.js";

/** Opens rules of the site. Resolves to whether they are open. */
export function openRules(key, { size: wanted = "64x64", run = true } = {}) {
  say(`Loading ${key}…`);
  return swap(async () => {
    const sizes = sizesOf(key);
    const [rows, columns] = sizes.find((one) => one.join("x") === wanted) ?? sizes[0];
    if (hasModule(key, rows, columns)) shippedModule(key, rows, columns).catch(() => {}); // both load at once
    const sheet = await sheetOf(key);
    const module = await unedited(sheet, rows, columns);
    const engine = await Engine.start(module);
    return () => {
      // Packs are opened to paint with their own elements, the first of which is the ground in rules of one pack.
      const own = engine.elements.find((one) => one.qualified.startsWith(`${key}.`) && one.id !== engine.ground);
      const named = { world: sheet.shown ?? "random", seed: app.named.seed };
      begin(engine, sheet, named);
      const world = engine.snapshot();
      const fresh = { sheet, module, compiled: false, edits: null, parameters: {}, world, start: world, named, painted: false };
      if (own) app.element = own.qualified;
      const kept = land(fresh, engine);
      setRunning(run);
      say([sheet.about || sheet.title, kept].filter(Boolean).join(" "));
    };
  });
}

/** Opens a moment as another piece of work. Returns what became of the present one, in words. */
function land(found, engine) {
  const first = app.engine === null;
  const kept = !first && isWork();
  if (!first) [remember(), app.save?.()];
  open({ work: newWork(), ...found, sitting: newSitting() }, engine);
  if (!first) app.save?.();
  return kept ? (app.save ? "Your earlier work is under Recent." : "Undo brings your earlier work back.") : "";
}

/** Opens rules of the menu. Its last entry asks for the seed of a universe. */
export function chooseRules(key) {
  if (key !== UNIVERSE) return openRules(key, { size: $("size").value }).catch(failed);
  showMenus();
  $("universe").querySelector("input").value = String(Math.floor(Math.random() * 1e6));
  return $("universe").showModal();
}

/** Worlds of tasks, which come after the first world runs. @param {Record<string, any[]>} found  by rules */
export async function addWorlds(found) {
  for (const [key, worlds] of Object.entries(found)) if (listedRules(key)) (await sheetOf(key)).worlds.push(...worlds);
  showMenus();
}

/** The seed that is typed, as the command line takes it; null if it takes none such. */
function typedSeed() {
  const text = $("seed").value.trim();
  const seed = /^\d{1,19}$/.test(text) ? BigInt(text) : Number.isSafeInteger(Number(text || NaN)) ? BigInt(Number(text)) : -1n;
  return seed >= 0n && seed <= MAX_CLOCK ? String(seed) : null;
}

/** Begins the chosen world, with the chosen seed. */
export function startWorld() {
  const seed = typedSeed();
  if (seed === null) {
    showMenus();
    say(`A seed is a whole number from 0 to ${MAX_CLOCK}: it is still ${app.named.seed}.`, true);
    return;
  }
  remember();
  const named = { ...app.named, world: $("world").value, seed };
  begin(app.engine, app.rules, named);
  Object.assign(app, { start: app.engine.snapshot(), named, painted: !named.world });
  clearChart();
  showMenus();
  refresh();
}

/** Begins a world in an engine. */
function begin(engine, sheet, { world: name, seed }) {
  const listed = sheet.worlds.find((one) => one.name === name);
  if (listed) {
    engine.restore(filling(readWorld(listed), sheet, engine));
    if (engine.clock().some(Boolean)) return;
  } else if (name === "") engine.restore(app.start);
  else if (name === "empty") engine.begin(framed(new Uint8Array(engine.cells).fill(engine.ground), engine, sheet.frame), 0);
  else engine.begin(scatter(engine, sheet.frame, BigInt(seed)), 0);
  engine.reseed(BigInt(seed));
}

/** A start world that fills a larger one: patterns of cellular automata are repeated, where things move they grow. */
function filling(world, sheet, { rows, columns }) {
  const [down, right] = [Math.floor(rows / world.rows), Math.floor(columns / world.columns)];
  const factor = Math.min(down, right);
  if (factor < 1 || down * right === 1) return world;
  return sheet.frame === null ? tiled(world, down, right) : enlarged(world, factor);
}

/** Continues with a world from elsewhere, which `reset` returns to. @param {import("./engine.js").Snapshot} world */
export function openWorld(world) {
  const { rows, columns } = world;
  return swap(async () => {
    const same = rows === app.engine.rows && columns === app.engine.columns;
    const engine = same ? app.engine : await Engine.start(await moduleOf(rows, columns));
    return () => {
      remember();
      app.keepParameters = true;
      if (engine !== app.engine) use(engine);
      engine.restore(world);
      const named = { ...app.named, world: "", seed: String(world.clock[0]) };
      Object.assign(app, { start: engine.snapshot(), named, painted: true });
      refresh();
    };
  });
}

/** Another size: a world that was painted keeps its cells, as far as they fit; any other one begins in the new size. */
export function resize() {
  const [rows, columns] = $("size").value.split("x").map(Number);
  say("Loading…");
  return swap(async () => {
    const engine = await Engine.start(await moduleOf(rows, columns));
    return () => {
      remember();
      const { named, painted, rules, start } = app;
      const before = app.engine.snapshot();
      app.keepParameters = true;
      use(engine);
      if (painted) engine.fit(start, rules.frame);
      else begin(engine, rules, named);
      app.start = engine.snapshot();
      if (painted) engine.fit(before, rules.frame);
      refresh();
      const cut = painted && (rows < before.rows || columns < before.columns);
      say(`${rows}×${columns} cells${cut ? "; what did not fit is cut, Undo brings it back" : ""}`);
    };
  }).catch(failed);
}

/**
 * Opens the work of a link or a file, or one that the browser has kept: changed files are compiled, unless the module is
 * there. Says `words` then. Resolves to whether it is open. `found` is what share.js reads, or what store.js keeps.
 */
export function openWork(found, { words, run = false, work } = {}) {
  const { files, key, off, parameters, world } = found;
  const { rows, columns } = world;
  const opened = swap(async () => {
    const sheet = listedRules(key) || (isUniverse(key) && !found.sheet) ? await sheetOf(key) : found.sheet;
    if (!sheet) throw new Error(`This page does not have the rules ${key}.`);
    const edited = files !== null || String(off) !== String(sheet.off);
    const own = { files: files ?? sheet.files, off };
    const good = found.good ?? own; // files with mistakes may run as those of the site
    const isShipped = hasModule(key, rows, columns) && JSON.stringify([good.files, good.off]) === JSON.stringify([sheet.files, sheet.off]);
    let module = found.module ?? (isShipped ? await shippedModule(key, rows, columns) : null);
    if (!module) say("Compiling the rules…");
    module ??= await (await import("./rules.js")).compile(good, rows, columns);
    // Rules with mistakes and no earlier ones without: those of the site run, until the mistakes are gone.
    const runs = module ?? (await unedited(sheet, ...sizesOf(key)[0]));
    const engine = await Engine.start(runs);
    return () => {
      const shown = found.shown ?? Object.keys(files ?? {}).find((name) => files[name] !== sheet.files[name]);
      const edits = edited ? { ...own, good: module ? good : sheet, shown, edited } : null;
      const named = found.named ?? { world: "", seed: String(world.clock[0]), from: found.from };
      const { painted = true, start = world } = found;
      const rest = { sheet, module: runs, compiled: edited && module !== null, parameters, painted, work: work ?? newWork() };
      const kept = land({ ...rest, edits, world, start, named }, engine);
      setRunning(run);
      if (module) say([words || sheet.about, kept].filter(Boolean).join(" "));
      else say("The rules have mistakes: see the list below the editor.", true);
    };
  });
  opened.catch(() => false).then((landed) => landed || (app.engine && app.edits?.recheck()));
  return opened;
}
