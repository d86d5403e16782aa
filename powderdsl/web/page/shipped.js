// What the site has of its rules: sheets that describe them, and modules; other modules are compiled.

import { get } from "./dom.js";
import { app } from "./state.js";

const known = new Map();

/** What a file of the site holds, read once. */
function once(path, read) {
  if (!known.has(path)) {
    const found = get(path).then(read);
    found.catch(() => known.delete(path));
    known.set(path, found);
  }
  return known.get(path);
}

const readModule = async (answer) => WebAssembly.compile(await answer.arrayBuffer());
/** The site's module of its own rules. */
export const shippedModule = (key, rows, columns) => once(`rules/${key}-${rows}x${columns}.wasm`, readModule);
export const sheetOf = (key) => (isUniverse(key) ? universe(key) : once(`rules/${key}.json`, (answer) => answer.json()));

/** Whether rules are those that the compiler makes of a seed. */
export const isUniverse = (key) => /^universe_\d{1,10}$/.test(key);

async function universe(key) {
  const { compiler } = await import("./compiler.js");
  return { key, ...(await compiler.call("universe", key.split("_")[1])) };
}

/** The row of the catalog about some rules; undefined if the site lacks them. */
export const listedRules = (key) => app.catalog.rules.find((one) => one.key === key);

/** The sizes that worlds of some rules have. */
export const sizesOf = (key) => listedRules(key)?.sizes ?? [64, 128, 256].map((side) => [side, side]);

/** A module of rules as they were before anybody edited them. */
export async function unedited(sheet, rows, columns) {
  if (hasModule(sheet.key, rows, columns)) return shippedModule(sheet.key, rows, columns);
  const { compile } = await import("./rules.js");
  return compile(sheet, rows, columns);
}

/** Whether the site has a module of its own rules for that size. */
export const hasModule = (key, rows, columns) =>
  listedRules(key)?.sizes.some((one) => one[0] === rows && one[1] === columns) ?? false;

/** A module of the rules that run, for some size. */
export async function moduleOf(rows, columns) {
  if (!app.compiled && hasModule(app.rules.key, rows, columns)) return shippedModule(app.rules.key, rows, columns);
  const { compiled } = await import("./rules.js");
  return compiled(rows, columns);
}
