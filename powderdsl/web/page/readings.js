// What the page reads from the running world: the chart of its elements, and the cell under the pointer.

import { $ } from "./dom.js";
import { app } from "./state.js";
import { chart } from "./view.js";

const CHART_EVERY = 100; // ms between two points of the chart
const CHART_POINTS = 200;

let counts = [];
let charted = 0;
/** @type {number[] | null} */ let hovered = null;

/** Begins the chart anew, for another world. */
export function clearChart() {
  counts = [];
}

/** Adds a point to the chart, if it is time for one. */
export function showReadings(now) {
  if (app.running && now - charted <= CHART_EVERY) return;
  charted = now;
  counts.push(app.engine.counts());
  if (counts.length > CHART_POINTS) counts.shift();
  const colors = [...app.colors].filter(([id]) => id !== app.engine.ground);
  chart($("chart"), counts, colors);
  if (hovered) showCell(hovered);
}

export function leaveCell() {
  hovered = null;
  $("hover").textContent = "\u00a0";
}

export function showCell([row, column]) {
  const { engine } = app;
  hovered = [row, column];
  if (row < 0 || column < 0 || row >= engine.rows || column >= engine.columns) {
    $("hover").textContent = "\u00a0";
    return;
  }
  const at = row * engine.columns + column;
  const words = [`(${row}, ${column})`, engine.byId.get(engine.ids()[at])?.name ?? ""];
  const all = [...words];
  engine.fields.forEach((field, number) => {
    const values = engine.field(number);
    const found = Array.from({ length: field.components }, (_, c) => values[c * engine.cells + at]);
    const word = `${field.name} ${found.map((value) => shown(field, value)).join(", ")}`;
    all.push(word);
    // The line has room for what is unusual; the tooltip has everything.
    if (found.some((value) => value !== 0 && !(field.kind === "element" && value === engine.ground))) words.push(word);
  });
  $("hover").textContent = words.join("  ·  ");
  $("hover").title = all.join("\n");
}

const DIRECTIONS = ["up", "up right", "right", "down right", "down", "down left", "left", "up left"];
function shown({ kind, type }, value) {
  if (kind === "element") return app.engine.byId.get(value)?.name ?? String(value);
  if (kind === "direction") return DIRECTIONS[value] ?? String(value);
  if (kind === "flag") return value ? "yes" : "no";
  return type === "float32" ? String(Math.round(value * 100) / 100) : String(value);
}
