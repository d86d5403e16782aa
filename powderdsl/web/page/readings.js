// What the page reads from the running world: the chart of its elements, and the cell under the pointer.

import { $, make } from "./dom.js";
import { app } from "./state.js";
import { chart, chartPoint } from "./view.js";

const CHART_EVERY = 100; // ms between two points of the chart
const CHART_POINTS = 200;
const NEAR = 4; // cells around one that a picture shows

/** @type {{step: bigint, counts: Map<string, number>}[]} counts by qualified names, which outlive changes of rules */
let points = [];
let charted = 0;
/** @type {number | null} the point that the pointer is at */ let pointed = null;
/** @type {number[] | null} */ let hovered = null;

/** Begins the chart anew, for another world. */
export function clearChart() {
  points = [];
}

/** Adds a point to the chart, if it is time for one. Points from here on are gone where the world went back. */
export function showReadings(now) {
  if (app.running && now - charted <= CHART_EVERY) return;
  charted = now;
  if (hovered) showCell(hovered);
  const { engine } = app;
  const [, , step] = engine.clock();
  const counts = engine.counts();
  points = points.filter((one) => one.step < step).slice(1 - CHART_POINTS);
  points.push({ step, counts: new Map(engine.elements.map((one) => [one.qualified, counts[one.id]])) });
  showChart();
}

function showChart() {
  const { colors, engine } = app;
  const present = engine.elements.filter((one) => one.id !== engine.ground && points.some(({ counts }) => counts.get(one.qualified)));
  const lines = present.map((one) => ({ color: colors.get(one.id), values: points.map(({ counts }) => counts.get(one.qualified) ?? 0) }));
  const at = Math.min(pointed ?? Infinity, points.length - 1);
  chart($("chart"), points.map((one) => String(one.step)), lines, pointed === null ? -1 : at);
  const entries = present.map((one, i) => {
    const swatch = make("i", { class: "swatch" });
    swatch.style.background = lines[i].color;
    return make("span", {}, swatch, `${one.name} ${lines[i].values[at]}`);
  });
  $("legend").replaceChildren(make("span", {}, `step ${points[at].step}`), ...entries);
}

$("chart").addEventListener("pointermove", (event) => {
  pointed = chartPoint($("chart"), event.offsetX, points.length);
  if (points.length) showChart();
});
$("chart").addEventListener("pointerleave", () => {
  pointed = null;
  if (points.length) showChart();
});

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

/** The cells around one, in a world of this size. @param {Uint8Array} ids */
export function neighborhood(ids, row, column, label) {
  const [size, { rows, columns }] = [2 * NEAR + 1, app.engine];
  const canvas = make("canvas", { width: size, height: size, role: "img", "aria-label": label });
  const context = canvas.getContext("2d");
  for (let y = 0; y < size; y++)
    for (let x = 0; x < size; x++) {
      const [at, to] = [row + y - NEAR, column + x - NEAR];
      if (at < 0 || to < 0 || at >= rows || to >= columns) continue;
      context.fillStyle = app.colors.get(ids[at * columns + to]) ?? "#888";
      context.fillRect(x, y, 1, 1);
    }
  return make("figure", { class: "near" }, make("div", {}, canvas), make("figcaption", {}, label));
}

export const DIRECTIONS = ["up", "up right", "right", "down right", "down", "down left", "left", "up left"];
function shown({ kind, type }, value) {
  if (kind === "element") return app.engine.byId.get(value)?.name ?? String(value);
  if (kind === "direction") return DIRECTIONS[value] ?? String(value);
  if (kind === "flag") return value ? "yes" : "no";
  return type === "float32" ? String(Math.round(value * 100) / 100) : String(value);
}
