// Puts the parts of the page together: keys, buttons, and the order in which things load.

import { $, failed, get } from "./dom.js";
import { addWorlds, chooseRules, openRules, openWork, resize, startWorld } from "./opening.js";
import { isStill, layout, newPainter, picture, refresh, setRunning } from "./stage.js";
import { app } from "./state.js";
import { restore } from "./store.js";
import { arrows, showPanel, toggleSheet } from "./tabs.js";
import { SPEEDS, choose, reset, setBrush, setSpeed, setTool, showComponents, showElements, stepOnce } from "./tools.js";
import { redo, undo } from "./work.js";

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
  m: () => app.record?.().catch(failed),
  "?": () => $("keys").showModal(),
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
  // Space presses the button that has the focus, unless that is chosen already, such as an element.
  if (event.key === " " && target.closest?.("button:not([aria-checked=true], [aria-selected=true])")) return;
  if (/^[1-9]$/.test(event.key)) choose(app.engine.elements[Number(event.key) - 1]);
  else if (Object.hasOwn(KEYS, event.key)) KEYS[event.key]();
  else return;
  event.preventDefault();
}

function attach() {
  $("keys-button").onclick = () => $("keys").showModal();
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
  for (const id of ["blind", "dark"]) {
    $(id).onchange = () => {
      newPainter();
      showElements();
      refresh();
    };
  }
  for (const one of document.querySelectorAll("[data-tool]")) one.onclick = () => setTool(one.dataset.tool);
  for (const one of document.querySelectorAll("[data-panel]")) one.onclick = () => toggleSheet(one.dataset.panel);
  for (const id of ["tool", "elements", "tabs"]) arrows($(id));
  document.addEventListener("keydown", key);
  new ResizeObserver(() => app.engine && layout()).observe($("frame"));
}

/** Lets a new version of the site take over, which the service worker fetched during an earlier visit. */
async function renew() {
  const waiting = (await navigator.serviceWorker?.getRegistration())?.waiting;
  if (!waiting) return;
  const changed = new Promise((resolve) => navigator.serviceWorker.addEventListener("controllerchange", () => resolve(true)));
  waiting.postMessage("replace");
  if (!(await Promise.race([changed, new Promise((resolve) => setTimeout(resolve, 1500))]))) return;
  location.reload();
  await new Promise(() => {});
}

/** Whether this browser has shown the first steps. */
function toured() {
  try {
    return localStorage.getItem("toured") !== null;
  } catch {
    return true; // it keeps nothing
  }
}

async function begin() {
  await renew().catch(() => {}); // frames may be refused
  const full = new URL(location.href);
  const asked = full.searchParams;
  const embedded = asked.has("embed");
  document.body.classList.toggle("embed", embedded);
  asked.delete("embed");
  $("full").href = full.href;
  attach();
  setTool("brush");
  setBrush(5);
  setSpeed(SPEEDS.indexOf(app.speed));
  showPanel("rules-panel");
  $("side").classList.add("closed");
  app.catalog = await (await get("catalog.json")).json();
  const first = app.catalog.rules.find((one) => one.key === asked.get("rules")) ?? app.catalog.rules[0];
  app.isBack = !embedded && (await restore().catch((error) => console.info(`powderdsl: ${error}`)));
  if (!app.isBack) await openRules(first.key, { size: first.sizes[0].join("x"), run: !isStill() });
  app.firstWorld = performance.now();
  // The rest comes after the first picture: the editor, and Python in a worker.
  await picture();
  if (embedded) {
    // Only rules that somebody has edited need the compiler.
    const { fromFragment } = await import("./share.js");
    const shared = await fromFragment(location.hash);
    if (shared?.files === null) await openWork(shared, { run: !isStill() });
    if (!shared?.files && !location.hash.startsWith("#universe=")) return;
  }
  await import("./compiler.js"); // its worker loads beside the editor
  await Promise.all([import("./panels.js"), import("./rules.js")]);
  await Promise.all([import("./exchange.js"), import("./checks.js"), import("./elements.js")]);
  if (!embedded && !app.isBack && !location.hash && !toured()) await import("./tour.js");
  await import("./tasks.js"); // its files are large
  await addWorlds(await (await get("tasks.json")).json());
}

globalThis.powderdsl = app; // for tests and for people who look at the page's console
begin().catch(failed);
