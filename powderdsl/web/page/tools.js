// Tools: what they do to the world, their buttons, and what can be undone.

import { $, fill, make, say } from "./dom.js";
import { ARRAYS } from "./engine.js";
import { DIRECTIONS, leaveCell, showCell } from "./readings.js";
import { redraw, refresh, setRunning, step } from "./stage.js";
import { app } from "./state.js";
import { markStop } from "./tabs.js";
import { remember, undo } from "./work.js";
import { Surface, region, stroke } from "./view.js";

export const SPEEDS = [1, 2, 5, 10, 20, 30, 60, 120, 240, 480];

let mask = new Uint8Array(0);
let erasing = false;

/** Applies the tool from one cell to another. */
function apply(from, to, erases = false) {
  const { engine, tool } = app;
  const { rows, columns } = engine;
  mask.fill(0);
  if (tool === "fill") {
    if (to[0] < 0 || to[1] < 0 || to[0] >= rows || to[1] >= columns) return;
    region(mask, rows, columns, ...to, engine.ids().slice());
  } else stroke(mask, rows, columns, from, to, app.brush);
  const chosen = engine.elements.find((one) => one.qualified === app.element).id;
  if (erases || tool === "erase") engine.paint(engine.ground, mask);
  else if (tool === "brush" || tool === "fill") engine.paint(chosen, mask);
  else if (tool === "wind" && engine.motion >= 0) {
    const [down, right] = [to[0] - from[0], to[1] - from[1]];
    if (down || right) engine.setField(engine.motion, mask, [down * 3, right * 3]);
  } else if (tool === "field" && engine.fields.length) setChosenField();
  app.checkpoints = [];
  redraw();
}

/** The number nearest to a value that such an array holds: it would wrap. */
function held(type, value) {
  const count = 2 ** (8 * type.BYTES_PER_ELEMENT);
  const low = new type([-1])[0] < 0 ? -count / 2 : 0;
  return type === Float32Array ? value : Math.min(Math.max(Math.round(value), low), low + count - 1);
}

function setChosenField() {
  const { engine } = app;
  const number = Number($("field").value);
  const { components } = engine.fields[number];
  const input = $("choice").hidden ? $("value") : $("choice");
  const value = held(ARRAYS[engine.fields[number].type], Number(input.value) || 0);
  if (components === 1) engine.setField(number, mask, [value]);
  else {
    const view = engine.field(number);
    const base = Number($("component").value) * engine.cells;
    for (let i = 0; i < mask.length; i++) if (mask[i]) view[base + i] = value;
    engine.calls.take(number);
  }
}

app.surface = new Surface($("canvas"), {
  start(cell, { erases = false, picks = false }) {
    if (picks) return choose(app.engine.byId.get(app.engine.ids()[cell[0] * app.engine.columns + cell[1]]));
    if (app.play) return app.play.act(cell);
    if (app.tool === "look") return app.explain ? app.explain(cell) : say("The compiler is still loading.");
    remember();
    app.painted = true;
    [app.held, erasing] = [cell, erases];
    if (app.tool === "wind") return refresh();
    apply(cell, cell, erases);
    refresh();
  },
  move(cell) {
    if (!app.held || app.tool === "fill") return;
    if (app.held[0] === cell[0] && app.held[1] === cell[1]) return;
    apply(app.held, cell, erasing);
    app.held = cell;
  },
  /** A second finger has come: the first one was not to paint. */
  cancel() {
    if (app.held) undo();
    app.held = null;
  },
  end: () => ([app.held, erasing] = [null, false]),
  hover: (cell) => [outline(cell), showCell(cell)],
  leave: () => [leaveCell(), outline(null)],
});

/** Outlines what a tool at a cell would change; nothing for null. */
export function outline(cell) {
  const { width, height } = $("overlay");
  const context = $("overlay").getContext("2d");
  context.clearRect(0, 0, width, height);
  const scale = width / app.engine.columns;
  if (app.play) return app.play.mark(context, scale, cell);
  if (!cell) return;
  const plain = ["fill", "look"].includes(app.tool);
  const across = plain ? 1 : app.brush.size;
  const low = -Math.floor((across - 1) / 2);
  const [top, left] = [(cell[0] + low) * scale, (cell[1] + low) * scale];
  for (const [color, wide] of [["#000c", 3], ["#fffe", 1.2]]) {
    context.strokeStyle = color;
    context.lineWidth = wide;
    context.beginPath();
    if (app.brush.shape === "square" || plain) context.rect(left, top, across * scale, across * scale);
    else context.arc(left + (across * scale) / 2, top + (across * scale) / 2, (across * scale) / 2, 0, 7);
    context.stroke();
  }
}

app.onFrame.push(() => {
  if (app.held && app.running && ["brush", "erase"].includes(app.tool)) apply(app.held, app.held, erasing);
});
app.onEngine.push((engine) => {
  mask = new Uint8Array(engine.cells);
  showElements();
  showFields();
});

export function reset() {
  remember();
  app.painted = app.named.world === "";
  app.engine.restore(app.start);
  refresh();
}

export function stepOnce() {
  setRunning(false);
  step();
  refresh();
}

// The buttons of tools and elements

export function choose(element) {
  if (!element) return;
  app.element = element.qualified;
  if (!["brush", "fill"].includes(app.tool)) setTool("brush");
  for (const one of $("elements").children) one.setAttribute("aria-checked", String(one.dataset.element === app.element));
  markStop($("elements"));
  $("rules-of").textContent = `Rules of ${element.name}`;
}

export function showElements() {
  const buttons = app.engine.elements.map((one, i) => {
    const swatch = make("i", { class: "swatch" });
    swatch.style.background = app.colors.get(one.id);
    const checked = one.qualified === app.element;
    const title = i < 9 ? `${one.qualified} (${i + 1})` : one.qualified;
    const attributes = { type: "button", role: "radio", "aria-checked": String(checked), "data-element": one.qualified, title };
    return make("button", { ...attributes, onclick: () => choose(one) }, swatch, make("span", {}, one.name));
  });
  $("elements").replaceChildren(...buttons);
  $("rules-of").textContent = `Rules of ${app.engine.elements.find((one) => one.qualified === app.element).name}`;
  markStop($("elements"));
}

function showFields() {
  const { fields, motion } = app.engine;
  fill($("field"), fields.map((one, i) => [String(i), one.name]), "0");
  for (const [tool, has] of [["wind", motion >= 0], ["field", fields.length > 0]]) {
    const button = document.querySelector(`[data-tool=${tool}]`);
    button.disabled = !has;
    if (!has && app.tool === tool) setTool("brush");
  }
  showComponents();
}

export function showComponents() {
  const { elements, fields } = app.engine;
  const { components, kind } = fields[Number($("field").value)] ?? {};
  $("component").hidden = components !== 2;
  const named = { element: elements.map((one) => [one.id, one.name]), direction: [...DIRECTIONS.entries()], flag: [[1, "yes"], [0, "no"]] };
  $("choice").hidden = !(kind in named);
  $("value").hidden = kind in named;
  fill($("choice"), named[kind] ?? [], String(named[kind]?.[0][0]));
}

export function setTool(tool) {
  const button = document.querySelector(`[data-tool=${tool}]`);
  if (!button || button.disabled) return;
  app.tool = tool;
  for (const one of document.querySelectorAll("[data-tool]")) one.setAttribute("aria-checked", String(one === button));
  markStop($("tool"));
  $("field-row").hidden = tool !== "field";
  $("canvas").style.cursor = tool === "look" ? "help" : "crosshair";
}

export function setBrush(size) {
  app.brush.size = Math.min(Math.max(size, 1), 40);
  $("brush-range").value = String(app.brush.size);
  $("brush-size").textContent = String(app.brush.size);
}

export function setSpeed(index) {
  app.speed = SPEEDS[index];
  $("speed").value = String(index);
  $("speed-text").textContent = `${app.speed} steps/s`;
}
