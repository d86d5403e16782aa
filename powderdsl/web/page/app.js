// Puts the parts of the page together: which rules, which world, which tool; runs, draws and edits.

import { blindColors } from "./colors.js";
import { Engine, History, enlarged, framed, scatter } from "./engine.js";
import { Painter, Surface, chart, region, stamp, stroke } from "./view.js";
import { readWorld } from "./worlds.js";

const SPEEDS = [1, 2, 5, 10, 20, 30, 60, 120, 240, 480];
const STEP_BUDGET = 11; // ms of a frame that steps may take
const CHART_EVERY = 100; // ms between two points of the chart
const CHART_POINTS = 200;
const CHECKPOINT_EVERY = 32; // steps of small worlds; fewer of large ones, which take longer to copy
const MOST_CHECKPOINTS = 8;

const $ = (id) => document.getElementById(id);

/** An element with attributes and children; text stays text. */
export function make(name, attributes = {}, ...children) {
  const found = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) found.addEventListener(key.slice(2), value);
    else if (value === true) found.setAttribute(key, "");
    else if (value !== false && value !== undefined) found.setAttribute(key, value);
  }
  found.append(...children);
  return found;
}

export const app = {
  /** @type {any} */ catalog: null,
  /** @type {any} what the site says about the rules */ rules: null,
  /** @type {Engine} */ engine: null,
  /** @type {Painter} */ painter: null,
  history: new History(),
  /** The world that `reset` returns to. @type {import("./engine.js").Snapshot} */ start: null,
  running: false,
  speed: 60,
  tool: "brush",
  element: "",
  brush: { shape: "disk", size: 5 },
  /** Functions that panels add; they are called with each new engine. */ onEngine: [],
  /** @type {(cell: number[]) => void} */ explain: () => say("The compiler is still loading."),
  /** What makes an engine of this size for rules that were edited; null for the site's own. */ compiled: null,
  frames: 0,
  /** Earlier moments of this world, from which its steps can be repeated; none from before an edit. */
  /** @type {import("./engine.js").Snapshot[]} */ checkpoints: [],
};

export function say(text, bad = false) {
  $("status").textContent = text;
  $("status").className = bad ? "bad" : "";
}

export async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${await answer.text()}`);
  return answer;
}

// Rules and worlds

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

/**
 * Opens rules of the site.
 */
export async function openRules(key, { world, size: wanted = "64x64", run = true } = {}) {
  say(`Loading ${key}…`);
  const listed = app.catalog.rules.find((one) => one.key === key);
  const shape = listed.sizes.some((one) => one.join("x") === wanted) ? wanted : listed.sizes[0].join("x");
  const [sheet, module] = await Promise.all([sheetOf(key), shippedModule(key, ...shape.split("x"))]);
  app.rules = sheet;
  app.compiled = null;
  $("rules").value = key;
  fill($("size"), listed.sizes.map((one) => [one.join("x"), one.join("×")]), shape);
  fillWorlds(world ?? sheet.shown);
  const engine = await Engine.start(module);
  // An added pack is opened to paint with its elements.
  const own = engine.elements.find((one) => one.qualified.startsWith(`${key}.`));
  if (own) app.element = own.qualified;
  app.keepParameters = false;
  use(engine);
  startWorld();
  setRunning(run);
  say(sheet.about || sheet.title);
  for (const one of app.onRules) one(sheet);
}
app.onRules = [];

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
async function addWorlds(found) {
  for (const [key, worlds] of Object.entries(found)) {
    if (!app.catalog.rules.some((one) => one.key === key)) continue;
    const sheet = await sheetOf(key);
    sheet.worlds.push(...worlds);
    if (app.rules === sheet) fillWorlds($("world").value);
  }
}

function fill(select, rows, chosen) {
  select.replaceChildren(...rows.map(([value, label]) => make("option", { value }, label)));
  select.value = chosen;
}

/** Puts an engine in the place of the present one. Its world is whatever it holds. */
export function use(engine) {
  const first = app.engine === null;
  const parameters = app.engine && new Map(app.engine.parameters.map((one, i) => [one.name, app.engine.values[i]]));
  app.engine = engine;
  app.checkpoints = [];
  if (parameters && app.keepParameters) {
    engine.parameters.forEach(({ name }, i) => parameters.has(name) && engine.setParameter(i, parameters.get(name)));
  }
  $("canvas").width = engine.columns;
  $("canvas").height = engine.rows;
  mask = new Uint8Array(engine.cells);
  newPainter();
  if (!engine.elements.some((one) => one.qualified === app.element)) {
    app.element = engine.elements[Math.min(2, engine.elements.length - 1)].qualified;
  }
  showElements();
  showFields();
  layout();
  counts = [];
  for (const one of app.onEngine) one(engine);
  if (first) requestAnimationFrame(frame);
}

function newPainter() {
  const colors = $("blind").checked ? blindColors(app.engine.elements) : new Map();
  app.painter = new Painter(app.engine, colors);
  app.colors = new Map(app.engine.elements.map((one) => [one.id, colors.get(one.id) ?? one.color]));
}

/** Begins the chosen world, with the chosen seed. */
function startWorld() {
  const { engine } = app;
  const seed = Number($("seed").value) >>> 0;
  const name = $("world").value;
  const listed = app.rules.worlds.find((one) => one.name === name);
  if (listed) {
    const world = readWorld(listed);
    const factor = Math.floor(Math.min(engine.rows / world.rows, engine.columns / world.columns));
    engine.restore(factor > 1 ? enlarged(world, factor) : world);
    if (!world.clock.some(Boolean)) engine.reseed(seed);
  } else if (name === "empty") {
    engine.begin(framed(new Uint8Array(engine.cells).fill(engine.ground), engine, app.rules.frame), seed);
  } else {
    engine.begin(scatter(engine, app.rules.frame, seed), seed);
  }
  app.start = engine.snapshot();
  app.history.clear();
  app.checkpoints = [];
  counts = [];
  refresh();
}

/** Continues with a world from elsewhere, which `reset` returns to. @param {import("./engine.js").Snapshot} world */
export function openWorld(world) {
  remember();
  const lost = app.engine.restore(world);
  app.start = app.engine.snapshot();
  refresh();
  return lost;
}

async function resize() {
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

// Running and drawing

let due = 0;
let last = 0;
let dirty = true;
let counts = [];
let charted = 0;
let hovered = null;
let mask = new Uint8Array(0);

export function setRunning(on) {
  app.running = on;
  due = 0;
  $("run").textContent = on ? "Pause" : "Run";
  $("run").classList.toggle("primary", !on);
}

export function refresh() {
  dirty = true;
  $("undo").disabled = !app.history.past.length;
  $("redo").disabled = !app.history.future.length;
}

function advance(now) {
  due = Math.min(due + ((now - last) / 1000) * app.speed, Math.max(1, app.speed / 4));
  const began = performance.now();
  while (due >= 1) {
    step();
    due -= 1;
    dirty = true;
    if (performance.now() - began > STEP_BUDGET) due = Math.min(due, 1);
    if (performance.now() - began > STEP_BUDGET) break;
  }
}

function step() {
  const { checkpoints, engine } = app;
  const now = engine.clock()[2];
  const every = BigInt(CHECKPOINT_EVERY * Math.max(1, Math.round(engine.cells / 65536)));
  if (!held && !(checkpoints.length && now - checkpoints.at(-1).clock[2] < every)) {
    checkpoints.push(engine.snapshot());
    if (checkpoints.length > MOST_CHECKPOINTS) checkpoints.shift();
  }
  engine.step(1);
}

function frame(now) {
  requestAnimationFrame(frame);
  app.frames++;
  if (app.running) advance(now);
  last = now;
  if (held && ["brush", "erase"].includes(app.tool) && app.running) apply(held, held);
  if (dirty) {
    dirty = false;
    $("canvas").getContext("2d").putImageData(app.painter.draw($("tint").checked), 0, 0);
    app.drawn?.(app.painter.image);
    const [, , step] = app.engine.clock();
    $("clock").textContent = `step ${step}`;
    if (now - charted > CHART_EVERY || !app.running) showCounts(now);
  }
}

function showCounts(now) {
  charted = now;
  counts.push(app.engine.counts());
  if (counts.length > CHART_POINTS) counts.shift();
  const colors = [...app.colors].filter(([id]) => id !== app.engine.ground);
  chart($("chart"), counts, colors);
  if (hovered) showCell(hovered);
}

function showCell([row, column]) {
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

function layout() {
  const { rows, columns } = app.engine;
  const box = $("frame").getBoundingClientRect();
  const ratio = window.devicePixelRatio || 1;
  let scale = Math.min((box.width - 4) / columns, (box.height - 4) / rows) * ratio;
  if (scale >= 2) scale = Math.floor(scale);
  for (const id of ["canvas", "overlay"]) {
    $(id).style.width = `${(columns * scale) / ratio}px`;
    $(id).style.height = `${(rows * scale) / ratio}px`;
  }
  $("overlay").width = columns * scale;
  $("overlay").height = rows * scale;
}

function outline(cell) {
  const { width, height } = $("overlay");
  const context = $("overlay").getContext("2d");
  context.clearRect(0, 0, width, height);
  if (!cell) return;
  const scale = width / app.engine.columns;
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

// Editing

let held = null;

export function remember() {
  app.history.keep(app.engine.snapshot());
  app.checkpoints = [];
}

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
  dirty = true;
}

function setChosenField() {
  const { engine } = app;
  const number = Number($("field").value);
  const { components } = engine.fields[number];
  const value = Number($("value").value) || 0;
  if (components === 1) engine.setField(number, mask, [value]);
  else {
    const view = engine.field(number);
    const base = Number($("component").value) * engine.cells;
    for (let i = 0; i < mask.length; i++) if (mask[i]) view[base + i] = value;
    engine.calls.take(number);
  }
}

let erasing = false;
const surface = new Surface($("canvas"), {
  start(cell, { erases = false, picks = false }) {
    if (picks) return choose(app.engine.byId.get(app.engine.ids()[cell[0] * app.engine.columns + cell[1]]));
    if (app.tool === "look") return app.explain(cell);
    remember();
    [held, erasing] = [cell, erases];
    if (app.tool === "wind") return refresh();
    apply(cell, cell, erases);
    refresh();
  },
  move(cell) {
    if (!held || app.tool === "fill") return;
    if (held[0] === cell[0] && held[1] === cell[1]) return;
    apply(held, cell, erasing);
    held = cell;
  },
  end() {
    [held, erasing] = [null, false];
  },
  hover(cell) {
    outline(cell);
    showCell(cell);
  },
  leave() {
    hovered = null;
    outline(null);
    $("hover").textContent = "\u00a0";
  },
});

function timeTravel(found) {
  if (!found) return;
  app.engine.restore(found);
  app.checkpoints = [];
  refresh();
}

const undo = () => app.history.past.length && timeTravel(app.history.undo(app.engine.snapshot()));
const redo = () => app.history.future.length && timeTravel(app.history.redo(app.engine.snapshot()));

function reset() {
  remember();
  app.engine.restore(app.start);
  counts = [];
  refresh();
}

function stepOnce() {
  setRunning(false);
  step();
  refresh();
}

// Tools

function choose(element) {
  if (!element) return;
  app.element = element.qualified;
  if (!["brush", "fill"].includes(app.tool)) setTool("brush");
  showElements();
}

function showElements() {
  const buttons = app.engine.elements.map((one, i) => {
    const swatch = make("i", { class: "swatch" });
    swatch.style.background = app.colors.get(one.id);
    const checked = one.qualified === app.element;
    const title = i < 9 ? `${one.qualified} (${i + 1})` : one.qualified;
    const attributes = { type: "button", role: "radio", "aria-checked": String(checked), title };
    return make("button", { ...attributes, onclick: () => choose(one) }, swatch, make("span", {}, one.name));
  });
  $("elements").replaceChildren(...buttons);
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

function showComponents() {
  $("component").hidden = app.engine.fields[Number($("field").value)]?.components !== 2;
}

function setTool(tool) {
  const button = document.querySelector(`[data-tool=${tool}]`);
  if (!button || button.disabled) return;
  app.tool = tool;
  for (const one of document.querySelectorAll("[data-tool]"))
    one.setAttribute("aria-checked", String(one === button));
  $("field-row").hidden = tool !== "field";
  $("canvas").style.cursor = tool === "look" ? "help" : "crosshair";
}

function setBrush(size) {
  app.brush.size = Math.min(Math.max(size, 1), 40);
  $("brush-range").value = String(app.brush.size);
  $("brush-size").textContent = String(app.brush.size);
}

function setSpeed(index) {
  app.speed = SPEEDS[index];
  $("speed").value = String(index);
  $("speed-text").textContent = `${app.speed} steps/s`;
}

const KEYS = {
  " ": () => setRunning(!app.running),
  ".": stepOnce,
  r: reset,
  b: () => setTool("brush"),
  e: () => setTool("erase"),
  f: () => setTool("fill"),
  w: () => setTool("wind"),
  v: () => setTool("field"),
  t: () => setTool("look"),
  "[": () => setBrush(app.brush.size - 1),
  "]": () => setBrush(app.brush.size + 1),
};

function key(event) {
  const target = event.composedPath()[0];
  if (target.closest?.("input, select, textarea, [contenteditable=true], summary")) return;
  const command = event.ctrlKey || event.metaKey;
  if (command && event.key.toLowerCase() === "z") {
    event.preventDefault();
    (event.shiftKey ? redo : undo)();
    return;
  }
  if (command || event.altKey) return;
  if (event.key === " " && target.closest?.("button")) return;
  if (/^[1-9]$/.test(event.key)) choose(app.engine.elements[Number(event.key) - 1]);
  else if (Object.hasOwn(KEYS, event.key)) KEYS[event.key]();
  else return;
  event.preventDefault();
}

export function showPanel(id) {
  for (const tab of document.querySelectorAll("[data-panel]")) {
    const on = tab.dataset.panel === id;
    tab.setAttribute("aria-selected", String(on));
    $(tab.dataset.panel).hidden = !on;
  }
  for (const one of app.onPanel) one(id);
}
app.onPanel = [];

function attach() {
  $("run").onclick = () => setRunning(!app.running);
  $("step").onclick = stepOnce;
  $("reset").onclick = reset;
  $("undo").onclick = undo;
  $("redo").onclick = redo;
  $("speed").oninput = () => setSpeed(Number($("speed").value));
  $("brush-range").oninput = () => setBrush(Number($("brush-range").value));
  $("shape").onchange = () => (app.brush.shape = $("shape").value);
  $("field").onchange = showComponents;
  $("seed").onchange = startWorld;
  $("world").onchange = startWorld;
  $("size").onchange = resize;
  $("rules").onchange = () => chooseRules($("rules").value);
  $("tint").onchange = refresh;
  $("blind").onchange = () => {
    newPainter();
    showElements();
    refresh();
  };
  for (const one of document.querySelectorAll("[data-tool]")) one.onclick = () => setTool(one.dataset.tool);
  for (const one of document.querySelectorAll("[data-panel]")) one.onclick = () => showPanel(one.dataset.panel);
  document.addEventListener("keydown", key);
  new ResizeObserver(() => app.engine && layout()).observe($("frame"));
}

function failed(error) {
  console.error(error);
  say(String(error.message ?? error), true);
}

async function begin() {
  attach();
  setTool("brush");
  setBrush(5);
  setSpeed(SPEEDS.indexOf(60));
  showPanel("rules-panel");
  app.catalog = await (await get("catalog.json")).json();
  fill($("rules"), app.catalog.rules.map((one) => [one.key, one.key]), app.catalog.rules[0].key);
  const [first] = app.catalog.rules;
  await openRules(first.key, { size: first.sizes[0].join("x") });
  app.firstWorld = performance.now();
  // The rest comes after the first picture: the editor, and Python in a worker.
  await import("./panels.js");
  await import("./rules.js");
  await Promise.all([import("./exchange.js"), import("./checks.js")]);
  await addWorlds(await (await get("tasks.json")).json());
}

app.surface = surface;
globalThis.powderdsl = app; // for tests and for people who look at the page's console
begin().catch(failed);
