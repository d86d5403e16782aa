// What the compiler knows about the rules: the ledger, invariants, tests; and why a cell changed.

import { $, make, report, say } from "./dom.js";
import { Engine } from "./engine.js";
import { rules } from "./rules.js";
import { setRunning } from "./stage.js";
import { app } from "./state.js";
import { showPanel } from "./tabs.js";
import { writeWorld } from "./worlds.js";

const packOf = (file) => file.replace(/\.ya?ml$/, "");

const why = make("div");
const ledger = make("div");
const invariants = make("div");
const tests = make("div");
const button = (label, action) => {
  const found = make("button", { type: "button" }, label);
  found.onclick = async () => {
    found.disabled = true;
    try {
      await action();
    } catch (error) {
      say(String(error.message ?? error), true);
    } finally {
      found.disabled = false;
    }
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
    const text = make("p", { class: "bad" }, one.problem);
    return make("div", {}, line, text, one.after.length ? picture(one.after, one.legend) : "");
  });
  tests.replaceChildren(...(shown.length ? shown : [make("p", { class: "soft" }, `${pack} has no tests.`)]));
});

/** A world of a test, drawn from its characters. */
function picture(lines, legend) {
  const rows = lines.map((line) => line.trim().split(/\s+/));
  const canvas = make("canvas", { class: "failed", width: rows[0].length, height: rows.length });
  const context = canvas.getContext("2d");
  rows.forEach((row, y) =>
    row.forEach((char, x) => {
      const element = app.engine.elements.find((one) => [one.name, one.qualified].includes(legend[char]));
      context.fillStyle = app.colors.get(element?.id) ?? "#888";
      context.fillRect(x, y, 1, 1);
    }),
  );
  canvas.style.width = `${rows[0].length * 18}px`;
  return make("div", {}, canvas, report(lines.join("\n")));
}

$("checks").replaceChildren(
  make("h2", {}, "Why a cell changed"),
  why,
  make("h2", {}, "Ledger: what rules create, destroy and conserve"),
  showLedger,
  ledger,
  make("h2", {}, "Invariants"),
  tryInvariants,
  invariants,
  make("h2", {}, "Tests"),
  runTests,
  tests,
);
why.replaceChildren(make("p", { class: "soft" }, "Choose Explain, then a cell of the world."));
rules.onApplied.push(() => {
  for (const one of [ledger, invariants, tests]) one.replaceChildren();
});

// Why a cell changed: the steps since a checkpoint are repeated until the last one that changed its element.

app.explain = async ([row, column]) => {
  setRunning(false);
  showPanel("checks");
  why.replaceChildren(make("p", { class: "soft" }, "Looking for the step that changed the cell…"));
  try {
    const { before, step, changed } = await lastChange(row, column);
    if (!before) {
      why.replaceChildren(make("p", { class: "soft" }, "Nothing has happened since it was painted: run a step first."));
      return;
    }
    const { parameters, values } = app.engine;
    const set = Object.fromEntries(parameters.map((one, i) => [one.name, values[i]]));
    const text = await rules.compiler.call("trace", writeWorld(before), row, column, set);
    const head = changed ? `It last changed in step ${step}.` : `It has not changed lately; this is step ${step}.`;
    why.replaceChildren(make("p", {}, head), report(text));
  } catch (error) {
    why.replaceChildren(make("p", { class: "bad" }, String(error.message ?? error)));
  }
};

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
      return { before: scratch.snapshot(), step: found + 1n, changed: true };
    }
    until = checkpoint.clock[2];
  }
  return { before: fallback, step: now, changed: false };
}
