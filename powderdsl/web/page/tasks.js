// Tasks that people play: a list, the agent's actions by clicks on the world, and results as links that are replayed.

import { $, failed, fill, get, make, say } from "./dom.js";
import { Judge, read, written } from "./judge.js";
import { openRules, openWorld } from "./opening.js";
import { listedRules, unedited } from "./shipped.js";
import { isStill, refresh, setRunning } from "./stage.js";
import { app } from "./state.js";
import { markStop, showPanel } from "./tabs.js";
import { outline } from "./tools.js";

const AIMS = ["up left", "up", "up right", "left", "nowhere", "right", "down left", "down", "down right"];
const FRAMES = 60; // pictures of the steps after an action, at most

/** The task that is played. @type {Judge | null} */ let judge = null;
let [choice, aim, acting] = [0, 5, false];
const json = (path) => get(path).then((answer) => answer.json());
const [scores, listed] = await Promise.all([json("scores.json"), json("tasks.json")]);
const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));

function showList() {
  if (judge && location.hash.startsWith("#task=")) history.replaceState(history.state, "", location.pathname + location.search);
  [judge, app.play] = [null, null];
  outline(null);
  const rows = Object.entries(listed).flatMap(([key, worlds]) => (listedRules(key) || key.startsWith("universe:") ? worlds : [])).map(({ name, about }) => [name.replace(/^task /, ""), about]);
  const buttons = rows.filter(([name]) => name in scores).map(([name, about]) => {
    const open = () => play(name, 0).catch(failed);
    return make("button", { type: "button", class: "wide", onclick: open }, make("strong", {}, name), make("small", {}, about));
  });
  $("tasks").replaceChildren(make("p", {}, "Agents learn these tasks. Try one: your actions and their steps are counted as an agent's are."), ...buttons);
}

/** Begins a task. @param {boolean} keeps  whether the world on the page stays as it is */
async function play(name, number, keeps = false) {
  const task = await json(`tasks/${name}.json`);
  const { rules, world } = task.starts[number];
  // Other rules may be opened meanwhile.
  if (app.rules.key !== rules && (keeps || !(await openRules(rules, { run: false })))) return;
  setRunning(false);
  const begun = await Judge.start(task, number, await unedited(app.rules, world.rows, world.columns));
  if (!keeps) await openWorld(begun.engine.snapshot());
  judge = begun;
  const { choices } = begun.task;
  choice = choices.findIndex((one) => one !== "nothing");
  app.play = { act: (cell) => act([...judge.bin(cell), choice, choices[choice] === "blow" ? aim : 4]).catch(failed), mark };
  showPanel("tasks");
  showTask();
}

/** Takes an action, and shows its steps. */
async function act(action) {
  const mine = judge;
  if (acting || mine.over) return;
  [acting, app.unsaved] = [true, true];
  setRunning(false);
  const { free, steps } = mine.task;
  const every = isStill() ? Infinity : Math.ceil((steps + (mine.left === 1 ? free : 0)) / FRAMES);
  try {
    for (const step of mine.act(action)) {
      if ((step + 1) % every || mine !== judge) continue;
      showWorld();
      await frame();
    }
  } finally {
    acting = false;
  }
  if (mine !== judge) return;
  showWorld();
  history.replaceState(history.state, "", address());
  showTask();
}

/** Draws the edges of the task's regions with their names, and the block at a cell. */
function mark(context, scale, cell) {
  const { columns } = judge.engine;
  [context.strokeStyle, context.fillStyle, context.lineWidth, context.font] = ["#c2185b", "#c2185b", 2, "600 13px system-ui"];
  const line = (...ends) => ends.forEach(([x, y], i) => context[i ? "lineTo" : "moveTo"](x * scale, y * scale));
  context.beginPath();
  for (const [name, cells] of Object.entries(judge.regions)) {
    cells.forEach((one, at) => {
      const [x, y] = [at % columns, Math.floor(at / columns)];
      if (!one) return;
      if (!x || !cells[at - 1]) line([x, y], [x, y + 1]);
      if (x === columns - 1 || !cells[at + 1]) line([x + 1, y], [x + 1, y + 1]);
      if (!cells[at - columns]) line([x, y], [x + 1, y]);
      if (!cells[at + columns]) line([x, y + 1], [x + 1, y + 1]);
    });
    const first = cells.indexOf(1);
    context.fillText(name, ((first % columns) + 0.5) * scale, Math.max(14, Math.floor(first / columns) * scale - 4));
  }
  context.stroke();
  if (!cell) return;
  const [top, bottom, left, right] = judge.box(judge.bin(cell));
  context.strokeStyle = "#1f5fbf";
  context.strokeRect(left * scale, top * scale, (right - left) * scale, (bottom - top) * scale);
}

function showWorld() {
  app.engine.restore(judge.engine.snapshot());
  app.painted = true;
  refresh();
}

const address = () => `#task=${judge.task.name}&world=${judge.number}&actions=${written(judge.actions)}`;
const rounded = (value) => String(Math.round(value * 1000) / 1000);

function showTask() {
  const { actions, left, over, success, task, total } = judge;
  const { about, brush, choices, goal, lines, name, starts } = task;
  const worlds = make("select", { onchange: ({ target }) => play(name, Number(target.value)).catch(failed) });
  fill(worlds, starts.map((_, i) => [String(i), String(i)]), String(judge.number));
  const button = (label, onclick, more = {}) => make("button", { type: "button", onclick, ...more }, label);
  const again = button("Start again", () => play(name, judge.number).catch(failed));
  const picks = choices.flatMap((one, i) => {
    if (one === "nothing") return [];
    const element = app.engine.elements.find(({ qualified }) => qualified === one);
    const swatch = make("i", { class: "swatch" });
    swatch.style.background = app.colors.get(element?.id) ?? "transparent";
    return [button(swatch, () => [(choice = i), showTask()], { role: "radio", "aria-checked": String(choice === i), "aria-label": element?.name ?? one })];
  });
  picks.forEach((one) => one.append(` ${one.ariaLabel}`));
  const group = make("div", { class: "row", role: "radiogroup", "aria-label": "What a click does" }, ...picks);
  const way = make("select", { onchange: ({ target }) => (aim = Number(target.value)) });
  fill(way, AIMS.map((one, i) => [String(i), one]), String(aim));
  const idle = button("Do nothing", () => act([0, 0, choices.indexOf("nothing"), 4]).catch(failed), { disabled: over });
  const ended = over ? (success ? " Done!" : goal.success ? " Not done." : " That was the last one.") : "";
  const rows = [["you", rounded(total)], ...Object.entries(scores[name]).map(([who, returns]) => [who, rounded(returns[judge.number])])];
  const table = make("table", {}, ...rows.map(([who, value]) => make("tr", {}, make("th", { scope: "row" }, who), make("td", {}, value))));
  const focused = [...$("tasks").querySelectorAll("button, select")].indexOf(document.activeElement);
  $("tasks").replaceChildren(
    make("h2", {}, name),
    make("p", {}, about),
    make("p", {}, ...lines.flatMap((line) => [make("code", {}, line), make("br")])),
    make("div", { class: "row" }, make("label", {}, "World ", worlds), again, button("All tasks", showList)),
    make("p", { "aria-live": "polite" }, make("strong", {}, `${left} of ${task.actions} actions left.`), ended || ` A click acts on ${brush.join("×")} cells; ${task.steps} steps follow${task.free ? `, ${task.free} more after the last action` : ""}.`),
    group,
    make("div", { class: "row" }, ...(choices[choice] === "blow" ? [make("label", {}, "Blow ", way)] : []), ...(choices.includes("nothing") ? [idle] : [])),
    table,
    make("p", { class: "soft" }, "Returns in this world. Random is a mean of 16 tries."),
    button("Share the result", () => shareResult().catch(failed), { disabled: !actions.length }),
  );
  markStop(group);
  outline(null);
  $("tasks").querySelectorAll("button, select")[focused]?.focus();
}

async function shareResult() {
  history.replaceState(history.state, "", address());
  const copied = await navigator.clipboard.writeText(location.href).then(() => true, () => false);
  say(`${copied ? "The link is copied" : "The address bar holds the link"}: it replays your actions.`);
}

/** Opens the task of a link, and replays the actions in it. */
export async function openTask(fragment, keeps = false) {
  const asked = new URLSearchParams(fragment.slice(1));
  const [name, number] = [asked.get("task"), Number(asked.get("world") ?? 0)];
  if (!Object.hasOwn(scores, name)) throw new Error(`This page has no task ${name}.`);
  const count = scores[name].nothing.length;
  if (!(number in scores[name].nothing)) throw new Error(`The task ${name} has the worlds 0 to ${count - 1} here.`);
  await play(name, number, keeps);
  const mine = judge;
  for (const one of mine ? read(asked.get("actions") ?? "", mine.task) : []) {
    if (mine !== judge) return;
    if (keeps && !judge.over) [...judge.act(one)];
    else await act(one);
  }
  if (!mine || mine !== judge) return;
  showTask();
  if (judge.actions.length) say(`These were ${judge.actions.length} actions of a link: they returned ${rounded(judge.total)}.`);
}

app.onRules.push(showList);
showList();
