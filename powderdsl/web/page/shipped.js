// What the site has of its rules: sheets that describe them, and modules; other modules are compiled.

import { get } from "./dom.js";
import { app } from "./state.js";

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
  if (!sheets.has(key)) {
    const found = get(`rules/${key}.json`).then((answer) => answer.json());
    found.catch(() => sheets.delete(key));
    sheets.set(key, found);
  }
  return sheets.get(key);
}

/** The row of the catalog about some rules; undefined if the site lacks them. */
export const listedRules = (key) => app.catalog.rules.find((one) => one.key === key);

/** Whether the site has a module of its own rules for that size. */
export const hasModule = (key, rows, columns) =>
  listedRules(key)?.sizes.some((one) => one[0] === rows && one[1] === columns) ?? false;

/** A module of the rules that run, for some size. */
export async function moduleOf(rows, columns) {
  if (!app.compiled && hasModule(app.rules.key, rows, columns)) return shippedModule(app.rules.key, rows, columns);
  const { compiled } = await import("./rules.js");
  return compiled(rows, columns);
}
