// The world on its canvas: runs it, draws it, and puts other engines in its place.

import { blindColors, darkColors } from "./colors.js";
import { $ } from "./dom.js";
import { showReadings } from "./readings.js";
import { app } from "./state.js";
import { Painter, Screen, image } from "./view.js";

const STEP_BUDGET = 11; // ms of a frame that steps may take
const CHECKPOINT_EVERY = 32; // steps of small worlds; fewer of large ones, which take longer to copy
const MOST_CHECKPOINTS = 8;

let due = 0;
let last = 0;
let dirty = true;
const screen = new Screen($("canvas"));

/** Puts an engine in the place of the present one. Its world is whatever it holds. */
export function use(engine) {
  const first = app.engine === null;
  const before = app.engine;
  const parameters = new Map(before?.parameters.flatMap((one, i) => (before.values[i] === one.value ? [] : [[one.name, before.values[i]]])));
  app.engine = engine;
  app.checkpoints = [];
  if (app.keepParameters) {
    engine.parameters.forEach(({ name }, i) => parameters.has(name) && engine.setParameter(i, parameters.get(name)));
  }
  $("canvas").width = engine.columns;
  $("canvas").height = engine.rows;
  newPainter();
  if (!engine.elements.some((one) => one.qualified === app.element)) {
    app.element = engine.elements[Math.min(2, engine.elements.length - 1)].qualified;
  }
  layout();
  for (const one of app.onEngine) one(engine);
  if (first) requestAnimationFrame(frame);
}

/** Chooses the colors anew: the palette has changed. */
export function newPainter() {
  const { elements, ground } = app.engine;
  const dark = $("dark").checked ? darkColors(elements, ground) : new Map();
  const shown = elements.map((one) => ({ ...one, color: dark.get(one.id) ?? one.color }));
  const colors = $("blind").checked ? blindColors(shown) : dark;
  app.painter = new Painter(app.engine, colors);
  app.colors = new Map(app.engine.elements.map((one) => [one.id, colors.get(one.id) ?? one.color]));
}

export function setRunning(on) {
  app.running = on;
  due = 0;
  $("run").textContent = on ? "Pause" : "Run";
  $("run").classList.toggle("primary", !on);
}

/** Has the world drawn in the next frame. */
export function redraw() {
  dirty = true;
}

/** After an edit: draws the world, and shows whether there is something to undo. */
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

export function step() {
  const { checkpoints, engine } = app;
  const now = engine.clock()[2];
  const every = BigInt(CHECKPOINT_EVERY * Math.max(1, Math.round(engine.cells / 65536)));
  if (!app.held && !(checkpoints.length && now - checkpoints.at(-1).clock[2] < every)) {
    checkpoints.push(engine.snapshot());
    if (checkpoints.length > MOST_CHECKPOINTS) checkpoints.shift();
  }
  engine.step(1);
}

/** Whether the user wants pages that do not move by themselves. */
export const isStill = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** Resolves when the first picture is on the screen. */
export const picture = () =>
  new Promise((resolve) => {
    const shown = () => {
      app.firstPicture ??= performance.now();
      resolve();
    };
    // A page in the background draws nothing, and still loads.
    requestAnimationFrame(() => requestAnimationFrame(shown));
    setTimeout(shown, 500);
  });

function frame(now) {
  requestAnimationFrame(frame);
  app.frames++;
  if (app.running) advance(now);
  last = now;
  for (const one of app.onFrame) one();
  if (dirty) {
    dirty = false;
    const tint = $("tint").checked;
    screen.show(app.painter, tint);
    app.drawn?.(() => image(screen, app.painter, tint));
    const [, , step] = app.engine.clock();
    $("clock").textContent = `step ${step}`;
    showReadings(now);
  }
}

export function layout() {
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
