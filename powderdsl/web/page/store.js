// What the browser keeps, in IndexedDB: the work of this tab as it goes on, and a list of earlier work.

import { $, failed, make, say } from "./dom.js";
import { openWork } from "./opening.js";
import { listedRules, sheetOf } from "./shipped.js";
import { isStill } from "./stage.js";
import { app } from "./state.js";
import { SPEEDS, setBrush, setSpeed, setTool } from "./tools.js";
import { bytesOf, isWork, moment, newWork } from "./work.js";

const MOST = 12; // pieces of work,
const ROOM = 128 * 2 ** 20; // and bytes of them all
const RUNS = 10_000; // ms between two saves of a world that runs

/** What the address asks for: rules, or the world of a link. */
const place = () => location.search + location.hash;

let base = null;
let saved = { step: 0n, at: 0 };
const channel = globalThis.BroadcastChannel && new BroadcastChannel("powderdsl");

const answer = (request) =>
  new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
const read = (store) => base.transaction(store).objectStore(store);

/** Gives up keeping work, and says so: in a private window, or where the disk is full. */
function give(error) {
  app.save = null;
  console.info(`powderdsl: ${error}`);
  say("This browser does not keep your work: save it, or share a link, before you leave.", true);
}

/** Keeps the present work, under its name. @param {boolean} open  whether this tab goes on with it */
function save(open = true) {
  const { sheet, edits, module, ...rest } = moment();
  const { files = null, off = sheet.off, good, shown } = edits ?? {};
  const bytes = bytesOf.get(module);
  const body = { ...rest, key: sheet.key, sheet: { ...sheet, worlds: [] }, files, off, good, shown, bytes };
  const { brush, element, running, speed, tool, work: id } = app;
  const settings = { blind: $("blind").checked, dark: $("dark").checked, tint: $("tint").checked, brush: { ...brush }, element, running, speed, tool };
  const changed = Object.keys(files ?? {}).filter((name) => files[name] !== sheet.files[name]);
  const title = [sheet.key, ...changed.slice(0, 2)].join(", ");
  const { rows, columns, fields, clock } = rest.world;
  const size = 2 * [...fields.values()].reduce((sum, { values }) => sum + values.byteLength, rows * columns) + (bytes?.length ?? 0);
  const [first, about] = [app.catalog.rules[0].key, `${rows}×${columns}, step ${clock[2]}`];
  const head = { id, when: Date.now(), title, about, size, open, first, isWork: isWork(), place: place(), settings, picture: picture() };
  const change = write((heads, works) => [works.put(body, id), heads.put(head)]);
  change.onabort = () => give(change.error);
  change.commit(); // at once: a page that is left hears no answers
  if (sessionStorage.getItem("work") !== id) prune(id);
  app.unsaved = false;
  saved = { step: clock[2], at: performance.now() };
  sessionStorage.setItem("work", id);
  if (history.state?.work !== id) history.replaceState({ work: id }, "");
}

const write = (act) => {
  const change = base.transaction(["heads", "works"], "readwrite");
  act(change.objectStore("heads"), change.objectStore("works"));
  return change;
};

/** Forgets the oldest work, where there is too much, but not one. */
const prune = (id) =>
  write((heads, works) => {
    heads.getAll().onsuccess = ({ target }) => {
      let [room, count] = [ROOM, { true: MOST, false: 3 }];
      for (const one of target.result.sort((a, b) => b.when - a.when)) {
        if ((room -= one.size) >= 0 && count[one.isWork]-- > 0) continue;
        if (one.id !== id) for (const store of [heads, works]) store.delete(one.id);
      }
    };
  });

function picture() {
  const { columns, rows } = app.engine;
  const whole = make("canvas", { width: columns, height: rows });
  whole.getContext("2d").putImageData(app.painter.draw($("tint").checked), 0, 0);
  const context = make("canvas", { width: 48, height: 48 }).getContext("2d");
  context.drawImage(whole, 0, 0, 48, 48);
  return context.getImageData(0, 0, 48, 48);
}

async function openKept(head, options) {
  const body = await answer(read("works").get(head.id));
  if (!body) return false;
  const module = body.bytes && (await WebAssembly.compile(body.bytes));
  channel?.postMessage(head.id);
  return openWork({ ...body, module }, { ...options, work: head.id });
}

/** Opens the work of this tab before it was loaded again; in a new tab, the last work on these rules. Resolves to whether. */
export async function restore() {
  const asked = indexedDB.open("powderdsl", 1);
  asked.onupgradeneeded = () => {
    asked.result.createObjectStore("heads", { keyPath: "id" });
    asked.result.createObjectStore("works");
  };
  base = await answer(asked);
  app.save = save;
  const heads = (await answer(read("heads").getAll())).sort((a, b) => b.when - a.when);
  // The address may have changed since it was kept, so the entry of the history says what it showed.
  const id = history.state?.work;
  let head = heads.find((each) => (id ? each.id === id : each.id === sessionStorage.getItem("work") && each.place === place()));
  const words = `Your work of ${time(head ?? heads[0])} is back.`;
  if (!head && !place() && heads[0]?.isWork && !heads[0].open && heads[0].first === app.catalog.rules[0].key) {
    const { key, sheet } = await answer(read("works").get(heads[0].id));
    // Rules that have changed on the disk are to be seen: earlier work on them is in the list.
    if (!listedRules(key) || JSON.stringify((await sheetOf(key)).files) === JSON.stringify(sheet.files)) [head] = heads;
  }
  if (!head) return false;
  const { blind, dark, tint, brush, element, running, speed, tool } = head.settings;
  [$("blind").checked, $("dark").checked, $("tint").checked, $("shape").value] = [blind, dark, tint, brush.shape];
  Object.assign(app, { element, brush });
  setBrush(brush.size);
  setSpeed(SPEEDS.indexOf(speed));
  setTool(tool);
  return openKept(head, { words: head.isWork ? words : "", run: running && !isStill() });
}

const time = (head) => head && new Date(head.when).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });

/** Lists the earlier work. */
async function list() {
  const heads = base ? await answer(read("heads").getAll()) : [];
  const rows = heads.filter((one) => one.isWork && one.id !== app.work).sort((a, b) => b.when - a.when).map((head) => {
    const canvas = make("canvas", { width: 48, height: 48 });
    canvas.getContext("2d").putImageData(head.picture, 0, 0);
    const words = make("span", {}, head.title, make("small", {}, `${head.about} · ${time(head)}`));
    const go = () => openKept(head, { words: `This is your work of ${time(head)}, paused.` }).catch(failed);
    const label = `Delete ${head.title} of ${time(head)}`;
    const drop = make("button", { type: "button", class: "small", title: label, "aria-label": label, onclick: () => remove(head).catch(failed) }, "✕");
    return make("div", {}, make("button", { type: "button", onclick: () => [($("recent").open = false), go()] }, canvas, words), drop);
  });
  const none = make("p", { class: "soft" }, "What you paint and write is kept here once you open something else.");
  $("recent").querySelector("div").replaceChildren(...(rows.length ? rows : [none]));
}

async function remove(head) {
  const body = await answer(read("works").get(head.id));
  write((heads, works) => [heads.delete(head.id), works.delete(head.id)]);
  const back = () => [write((heads, works) => [heads.put(head), works.put(body, head.id)]), list().catch(failed)];
  await list();
  say(`${head.title} of ${time(head)} is deleted. `, false, make("button", { type: "button", class: "small", onclick: back }, "Undo"));
}

$("recent").addEventListener("toggle", () => $("recent").open && list().catch(failed));
channel?.addEventListener("message", ({ data }) => data === app.work && Object.assign(app, { work: newWork(), unsaved: true }));
// Not before a link is open, which the work would take for its own.
const now = (open) => app.engine && (app.linkOpened || !location.hash) && app.save?.(open);
setInterval(() => {
  if (!app.engine || app.held || app.swapping) return;
  const runs = app.engine.clock()[2] !== saved.step && performance.now() - saved.at > RUNS;
  if (app.unsaved || runs) now();
}, 1000);
// The first gives a busy disk more time; not all browsers send it.
for (const name of ["beforeunload", "pagehide"]) addEventListener(name, () => now(false));
addEventListener("pageshow", ({ persisted }) => persisted && now());
addEventListener("popstate", ({ state }) => {
  if (state?.work && state.work !== app.work && base) openKept({ id: state.work }, { words: "This is your earlier work, paused." }).then((landed) => landed || (app.unsaved = true), failed);
});
