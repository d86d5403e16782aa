// What the compiler knows about the rules: the ledger, invariants, tests; and why a cell changed.

import { $, failed, make, report } from "./dom.js";
import { Engine } from "./engine.js";
import { neighborhood } from "./readings.js";
import { goTo, rules } from "./rules.js";
import { setRunning } from "./stage.js";
import { app } from "./state.js";
import { showPanel } from "./tabs.js";
import { writeWorld } from "./worlds.js";

const packOf = (file) => file.replace(/\.ya?ml$/, "");

const [why, ledger, invariants, tests] = [1, 2, 3, 4].map(() => make("div"));
const button = (label, action) => {
  const found = make("button", { type: "button" }, label);
  found.onclick = () => {
    found.disabled = true;
    action().catch(failed).finally(() => (found.disabled = false));
  };
  return found;
};
const showLedger = button("Show the ledger", async () => {
  ledger.replaceChildren(report(await rules.compiler.call("ledger")));
});
const MARKS = { proven: "✓", tried: "✓", tested: "✓", broken: "✗", differs: "≠" };
const WORDS = { proven: "proven", tried: "holds in all worlds tried", broken: "broken", differs: "differs with added packs" };

const tryInvariants = button("Check the invariants", async () => {
  invariants.replaceChildren(make("p", { class: "soft" }, "Proving, and trying worlds: some seconds…"));
  const found = await rules.compiler.call("invariants");
  invariants.replaceChildren(
    ...found.map(({ text, status, note, owner }) => {
      const mark = make("span", { class: status === "broken" ? "bad" : "good" }, `${MARKS[status] ?? "?"} `);
      const head = make("summary", {}, mark, text, make("span", { class: "soft" }, ` (${owner}): ${WORDS[status] ?? status}`));
      return make("details", { class: "result", open: status === "broken" }, head, report(note || "no world breaks it"));
    }),
  );
  if (!found.length) invariants.replaceChildren(make("p", { class: "soft" }, "These rules state no invariants."));
});

const runTests = button("Run the tests of the shown pack", async () => {
  const pack = packOf(rules.shown);
  tests.replaceChildren(make("p", { class: "soft" }, `Running the tests of ${pack}…`));
  const found = await rules.compiler.call("tests", pack);
  const shown = found.map((one) => {
    const mark = make("span", { class: one.passed ? "good" : "bad" }, one.passed ? "✓ " : "✗ ");
    const line = make("p", {}, mark, one.name, make("span", { class: "soft" }, `  ${one.place}`));
    if (one.passed) return line;
    const worlds = [["given", one.given], ["expected", one.expect], [`got, step ${one.step}`, one.after]];
    const drawn = worlds.filter(([, lines]) => lines.length).map(([name, lines]) => picture(name, lines, one.legend));
    return make("div", {}, line, make("p", { class: "bad" }, one.problem), make("div", { class: "row" }, ...drawn));
  });
  tests.replaceChildren(...(shown.length ? shown : [make("p", { class: "soft" }, `${pack} has no tests.`)]));
});

/** A world of a test, drawn from its characters; `?` is any element. */
function picture(name, lines, legend) {
  const [rows, columns] = [lines.length, Math.max(...lines.map((line) => line.length))];
  const canvas = make("canvas", { class: "failed", width: columns, height: rows, role: "img", "aria-label": `${name}:\n${lines.join("\n")}` });
  const context = canvas.getContext("2d");
  lines.forEach((line, y) =>
    [...line].forEach((char, x) => {
      const element = app.engine.elements.find((one) => [one.name, one.qualified].includes(legend[char]));
      context.fillStyle = app.colors.get(element?.id) ?? "#888";
      context.fillRect(x, y, 1, 1);
    }),
  );
  canvas.style.width = `${columns * Math.min(18, Math.max(4, Math.floor(160 / columns)))}px`;
  return make("figure", {}, canvas, make("figcaption", { class: "soft" }, name));
}

const parts = { "Why a cell changed": [why], "Ledger: what rules create, destroy and conserve": [showLedger, ledger] };
Object.assign(parts, { Invariants: [tryInvariants, invariants], Tests: [runTests, tests] });
$("checks").replaceChildren(...Object.entries(parts).flatMap(([title, nodes]) => [make("h2", {}, title), ...nodes]));
why.replaceChildren(make("p", { class: "soft" }, "Choose Explain, then a cell of the world."));
rules.onApplied.push(() => {
  for (const one of [ledger, invariants, tests]) one.replaceChildren();
});

// Why a cell changed: the steps since a checkpoint are repeated until the last one that changed its element.

let asked = 0;
let tracing = Promise.resolve();

/** Explains the cell that was asked about last: one at a time, since a trace may take seconds. */
app.explain = (cell) => {
  const mine = ++asked;
  tracing = tracing.then(() => mine === asked && explain(cell));
};

async function explain([row, column]) {
  setRunning(false);
  showPanel("checks");
  why.replaceChildren(make("p", { class: "soft" }, "Looking for the step that changed the cell…"));
  try {
    const { before, after, step, changed } = await lastChange(row, column);
    if (!before) {
      why.replaceChildren(make("p", { class: "soft" }, "Nothing has happened since it was painted: run a step first."));
      return;
    }
    const { parameters, values } = app.engine;
    const set = Object.fromEntries(parameters.map((one, i) => [one.name, values[i]]));
    const { text, data } = await rules.compiler.call("trace", writeWorld(before), row, column, set);
    const pictures = make("div", { class: "row" }, neighborhood(before.ids, row, column, "before"), neighborhood(after, row, column, "after"));
    const more = make("details", { class: "result" }, make("summary", {}, "All rules that wrote it, or nearly did"), report(text));
    why.replaceChildren(make("p", {}, ...sentence(data, row, column, step, changed)), pictures, more);
  } catch (error) {
    why.replaceChildren(make("p", { class: "bad" }, String(error.message ?? error)));
  }
}

/** What a trace says about the element, with a link to the rule. */
function sentence({ slots, writes }, row, column, step, changed) {
  const { before, after, writer } = slots.element;
  const cell = `The cell (${row}, ${column})`;
  if (!changed) return [`${cell} has not changed lately. In step ${step} it was ${before}.`];
  const last = writes.findLast((one) => one.slot === "element" && one.after === after && one.after !== one.before);
  const from = last?.source ? ` that came from (${last.source.join(", ")})` : "";
  const head = `${cell} changed from ${before} to ${after}${from} in step ${step}`;
  if (!writer) return [`${head}, by no rule.`];
  const go = () => goTo(writer.file, writer.line, writer.column);
  const link = make("button", { type: "button", class: "small", onclick: go, title: "Show the rule" }, `${writer.file}:${writer.line}`);
  return [`${head}, by `, make("code", {}, writer.text), " ", link];
}

async function lastChange(row, column) {
  const now = app.engine.clock()[2];
  const at = row * app.engine.columns + column;
  const scratch = await Engine.start(app.engine.module);
  app.engine.values.forEach((value, i) => scratch.setParameter(i, value));
  let until = now;
  let fallback = null;
  for (const checkpoint of [...app.checkpoints].reverse()) {
    let found = null;
    scratch.restore(checkpoint);
    let element = scratch.ids()[at];
    while (scratch.clock()[2] < until) {
      const step = scratch.clock()[2];
      if (step === now - 1n) fallback = scratch.snapshot();
      scratch.step(1);
      const next = scratch.ids()[at];
      if (next !== element) found = step;
      element = next;
    }
    if (found !== null) {
      scratch.restore(checkpoint);
      scratch.step(Number(found - checkpoint.clock[2]));
      const before = scratch.snapshot();
      scratch.step(1);
      return { before, after: scratch.ids(), step: found + 1n, changed: true };
    }
    until = checkpoint.clock[2];
  }
  return { before: fallback, after: app.engine.ids(), step: now, changed: false };
}
