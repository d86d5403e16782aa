// Parameters as sliders, and the gallery of live pictures.

import { $, make } from "./dom.js";
import { Engine } from "./engine.js";
import { chooseRules } from "./opening.js";
import { sheetOf, shippedModule } from "./shipped.js";
import { isStill } from "./stage.js";
import { app } from "./state.js";
import { Painter } from "./view.js";
import { remember } from "./work.js";
import { readWorld } from "./worlds.js";

const LIVE_EVERY = 100; // ms between two steps of a picture

/** What a parameter is about, and the first line of its pack that uses it. */
function described({ name, about }) {
  const [pack, own] = name.split(".");
  const file = `${pack}.yaml`;
  const lines = ((app.edits?.files ?? app.rules.files)[file] ?? "").split("\n");
  const uses = (line) => new RegExp(`\\b${own}\\b`).test(line) && !new RegExp(`^ *(about:|params:|#)|(^|[{,]) *${own}:`).test(line);
  const at = lines.findIndex(uses);
  const found = about ? [make("small", {}, about)] : [];
  if (at < 0) return found;
  const go = () => import("./rules.js").then(({ goTo }) => goTo(file, at + 1, lines[at].search(new RegExp(`\\b${own}\\b`)) + 1));
  const link = make("button", { type: "button", class: "small", onclick: go, title: "Show the line" }, `${file}:${at + 1}`);
  return [...found, make("small", {}, make("code", {}, lines[at].trim().replace(/^- /, "")), " ", link)];
}

function showParameters(engine) {
  const rows = engine.parameters.map((one, number) => {
    const whole = one.kind === "int" || one.kind === "flag";
    const range = make("input", { type: "range", min: one.low, max: one.high, step: whole ? 1 : "any", "aria-label": one.name });
    range.value = String(engine.values[number]);
    const word = (value) => (one.kind === "chance" ? `${Math.round(value * 1e5) / 1e3} %` : String(Math.round(value * 1e4) / 1e4));
    const output = make("output", {}, word(engine.values[number]));
    let sliding = false; // one drag is one change to undo
    range.onchange = () => (sliding = false);
    const set = (value) => {
      if (!sliding) remember();
      sliding = true;
      engine.setParameter(number, value);
      output.textContent = word(value);
    };
    range.oninput = () => set(Number(range.value));
    const back = make("button", { type: "button", title: "Back to the file's value" }, "↺");
    back.onclick = () => {
      range.value = String(one.value);
      set(one.value);
      sliding = false;
    };
    return make("div", { class: "parameter" }, make("span", {}, one.name), make("span", {}, output, " ", back), range, ...described(one));
  });
  $("parameters").replaceChildren(...(rows.length ? rows : [make("p", { class: "soft" }, "These rules have no parameters.")]));
}

app.onEngine.push(showParameters);
if (app.engine) showParameters(app.engine);

// The gallery

let cards = null;
let timer = null;

async function showGallery() {
  if (!cards) {
    cards = [];
    const shown = app.catalog.rules.map((one) => {
      const canvas = make("canvas", { width: 64, height: 64 });
      const open = () => chooseRules(one.key);
      const attributes = { type: "button", class: "card", onclick: open };
      cards.push({ key: one.key, sizes: one.sizes, canvas, engine: null, painter: null });
      return make("button", attributes, canvas, make("strong", {}, one.key), make("small", {}, one.about));
    });
    $("gallery").replaceChildren(...shown);
    for (const card of cards) await startCard(card);
  }
}

async function startCard(card) {
  const [rows, columns] = card.sizes[0];
  const [sheet, module] = await Promise.all([sheetOf(card.key), shippedModule(card.key, rows, columns)]);
  const engine = await Engine.start(module);
  engine.restore(pictured(sheet));
  [card.canvas.width, card.canvas.height] = [columns, rows];
  card.sheet = sheet;
  card.painter = new Painter(engine);
  card.engine = engine;
}

/** The world that shows the rules best. */
const pictured = (sheet) => readWorld(sheet.worlds.find((one) => one.name === sheet.shown));

function live() {
  for (const { engine, painter, canvas, sheet } of cards ?? []) {
    if (!engine) continue;
    if (!isStill()) engine.step(1);
    if (engine.clock()[2] > 600n) engine.restore(pictured(sheet));
    canvas.getContext("2d").putImageData(painter.draw(), 0, 0);
  }
}

app.onPanel.push((id) => {
  clearInterval(timer);
  if (id !== "gallery") return;
  showGallery().catch((error) => console.error(error));
  timer = setInterval(live, LIVE_EVERY);
});
