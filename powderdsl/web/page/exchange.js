// Files and links: what leaves the page, and what comes back in.

import { $, commandLine, failed, make, say } from "./dom.js";
import { Recorder, download, gif, png } from "./media.js";
import { openRules, openWork, openWorld } from "./opening.js";
import { addFile, addRuleset, isRuleset, rules } from "./rules.js";
import { MAX_SHARED, fromBytes, fromFragment, rounded, toBytes, toFragment } from "./share.js";
import { isUniverse, listedRules, sheetOf } from "./shipped.js";
import { isStill, setRunning } from "./stage.js";
import { app } from "./state.js";
import { missing, webm } from "./video.js";
import { changedParameters } from "./work.js";
import { readWorld, text, writeWorld } from "./worlds.js";

const MAX_FILE = 32 << 20;
const recorder = new Recorder();
app.drawn = (draw) => recorder.add(draw);
app.recorder = recorder;

/** The files that differ from the site's; null for a file of the site that is gone. */
function changedFiles() {
  const found = {};
  for (const [name, content] of Object.entries(rules.files)) {
    if (app.rules.files[name] !== content) found[name] = content;
  }
  for (const name of Object.keys(app.rules.files)) if (!(name in rules.files)) found[name] = null;
  return Object.keys(found).length ? found : null;
}

const present = () => {
  const world = app.engine.snapshot();
  const { from } = app.named;
  return { key: app.rules.key, files: changedFiles(), off: [...rules.off], parameters: changedParameters(), from, world };
};

async function share() {
  const shared = present();
  const start = location.href.split("#")[0];
  const long = start + (await toFragment(shared));
  const isLong = long.length > MAX_SHARED;
  const address = isLong ? start + (await toFragment({ ...shared, world: rounded(shared.world) })) : long;
  const count = (one) => one.length.toLocaleString("en");
  if (address.length > MAX_SHARED) {
    const button = make("button", { type: "button", class: "small", onclick: () => saveAll(shared).catch(failed) }, "Save world.powder");
    const most = MAX_SHARED.toLocaleString("en");
    say(`A link would have ${count(address)} characters; programs pass on ${most} at most. A file holds it all: `, true, button);
    return;
  }
  history.replaceState(history.state, "", new URL(address).hash);
  app.unsaved = true;
  const words = isLong ? " Fields are rounded, so that it is short enough: the world may go on otherwise." : "";
  try {
    await navigator.clipboard.writeText(address);
    say(`The link is copied: ${count(address)} characters hold the rules and the world.${words}`);
  } catch {
    say(`The address bar holds the link: ${count(address)} characters.${words}`);
  }
}

/** Saves what a link holds, of any size. */
const saveAll = async (shared) => download(new Blob([await toBytes(shared)]), "world.powder");

/** Opens what a link holds. */
export async function openLink(fragment) {
  if (fragment.startsWith("#task=")) return (await import("./tasks.js")).openTask(fragment, app.isBack && !app.linkOpened);
  const universe = /^#universe=0*(\d{1,10})$/.exec(fragment);
  if (universe) return openRules(`universe_${universe[1]}`, { run: !isStill() });
  const shared = await fromFragment(fragment);
  if (shared === null) return false;
  const earlier = shared.from.length - 1;
  const remix = earlier ? ` It is a remix, of ${earlier === 1 ? "one work" : `${earlier} works, one after the other`}.` : "";
  return openShared(shared, `This is the world of the link, paused.${remix}`);
}

async function openShared(shared, words) {
  const { files: changed, key } = shared;
  if (!listedRules(key) && !isUniverse(key)) throw new Error(`It uses the rules ${key}, which this page does not have.`);
  const files = changed && { ...(await sheetOf(key)).files, ...changed };
  for (const name of Object.keys(files ?? {})) if (files[name] === null) delete files[name];
  return openWork({ ...shared, files }, { words });
}

async function saveWorld() {
  say("Writing the world…");
  const data = await rules.compiler.call("save", writeWorld(app.engine.snapshot()));
  const { rules: named, files } = await rules.compiler.call("command");
  download(new Blob([data]), "world.npz");
  const settings = Object.entries(changedParameters()).map(([name, value]) => ` --set ${name}=${value}`);
  const command = commandLine(`powderdsl run ${named} --world world.npz${settings.join("")}`);
  if (!files.length) {
    say("world.npz is saved. This continues it: ", false, command);
    return;
  }
  const button = make("button", { type: "button", class: "small" }, files.length > 1 ? "Save rules.zip" : `Save ${files[0]}`);
  button.onclick = () => saveRules().catch(failed);
  const then = files.length > 1 ? " beside it, and unpack that. Then this continues the world: " : " beside it. Then this continues the world: ";
  say("world.npz is saved. Its rules are not shipped: ", false, button, then, command);
}

/** Saves what the command line needs beside the shipped rules: one file, or several in a zip. */
async function saveRules() {
  const { files } = await rules.compiler.call("command");
  download(new Blob([await rules.compiler.call("save_rules")]), files.length > 1 ? "rules.zip" : files[0]);
}

/** Says what the entries of the menu save now. */
async function showEntries() {
  $("save-pack").textContent = `Rule file (${rules.shown})`;
  // The entry changes once, after the compiler's answer: hiding it until then makes an open menu jump.
  const files = rules.edited ? (await rules.compiler.call("command")).files : [];
  $("save-rules").hidden = files.length === 0 || (files.length === 1 && files[0] === rules.shown);
  $("save-rules").textContent = files.length === 1 ? `Edited rule file (${files[0]})` : `All ${files.length} edited rule files (.zip)`;
}

/** Animations take a while: their progress is shown. */
async function saveFilm(make, name) {
  const film = await make(recorder, (part) => say(`Writing ${name}: ${Math.round(100 * part)} %`));
  download(film, name);
  say(`${name} is saved.`);
}

/** Begins a recording, or ends one and saves it: as a video where the browser can. */
app.record = async () => {
  const on = recorder.toggle();
  $("canvas").classList.toggle("recording", on);
  $("record").textContent = on ? "End the recording (M)" : "Record (M)";
  if (on) {
    setRunning(true);
    say("Recording. Press M to end and save it.");
  } else if (await missing()) await saveFilm(gif, "world.gif");
  else await saveFilm(webm, "world.webm");
};

/** Opens files that were dropped or chosen, together. */
async function openAll(list) {
  const texts = {};
  const worlds = [];
  for (const file of list) {
    if (file.size > MAX_FILE) throw new Error(`${file.name} is larger than ${MAX_FILE >> 20} MiB.`);
    if (!/\.ya?ml$/i.test(file.name)) worlds.push(file);
    else texts[fileName(file.name)] = await file.text();
  }
  if (Object.values(texts).some(isRuleset)) addRuleset(texts);
  else for (const [name, text] of Object.entries(texts)) addFile(name, text);
  for (const file of worlds) await openWorldFile(file);
}

function fileName(given) {
  const name = given.replace(/\.ya?ml$/i, ".yaml");
  if (!/^[A-Za-z0-9_][A-Za-z0-9_-]{0,60}\.yaml$/.test(name)) throw new Error(`${given}: rename it to letters, digits, _ and -`);
  return name;
}

async function openWorldFile(file) {
  const data = new Uint8Array(await file.arrayBuffer());
  if (/\.powder$/i.test(file.name)) return openShared(await fromBytes(() => data), `This is the world of ${file.name}, paused.`);
  const reading = rules.compiler.call("open_world", text(data));
  const world = readWorld(await reading.catch(({ message }) => Promise.reject(new Error(message.replace("opened.npz", file.name)))));
  if (await openWorld(world)) say(`${file.name}: ${world.rows}×${world.columns} cells, step ${world.clock[2]}`);
}

const on = (id, action) =>
  $(id).addEventListener("click", () => {
    $("save").open = false;
    Promise.resolve(action()).catch(failed);
  });

on("share", share);
on("save-all", () => saveAll(present()));
on("save-world", saveWorld);
on("save-pack", () => download(new Blob([rules.files[rules.shown]], { type: "text/yaml" }), rules.shown));
on("save-rules", saveRules);
on("save-png", async () => download(await png(app.painter.draw($("tint").checked)), "world.png"));
on("record", app.record);
on("save-gif", () => saveFilm(gif, "world.gif"));
on("save-webm", () => saveFilm(webm, "world.webm"));
$("save").addEventListener("toggle", () => $("save").open && showEntries().catch(failed));
for (const menu of document.querySelectorAll(".menu")) {
  addEventListener("pointerdown", ({ target }) => menu.contains(target) || (menu.open = false));
  addEventListener("keydown", ({ key }) => {
    if (key !== "Escape" || !menu.open) return;
    menu.open = false;
    menu.querySelector("summary").focus();
  });
}
missing().then((reason) => {
  $("save-webm").disabled = $("no-video").textContent = reason;
  $("no-video").hidden = !reason;
});
/** Opens the universe of a seed at its own address, so that Back leads away from it. */
$("universe").addEventListener("submit", ({ target }) => {
  const hash = `#universe=${target.elements.seed.value}`;
  if (location.hash === hash) openLink(hash).catch(failed);
  else location.hash = hash;
});
for (const one of document.querySelectorAll("dialog [value='']")) one.onclick = () => one.closest("dialog").close();
on("open", () => $("file").click());
$("file").onchange = () => {
  openAll([...$("file").files]).catch(failed);
  $("file").value = "";
};
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  openAll([...(event.dataTransfer?.files ?? [])]).catch(failed);
});
// Not hashchange: that comes later, when the present work may have been kept as that of the link.
addEventListener("popstate", ({ state }) => state?.work || openLink(location.hash).catch(failed));
(app.isBack && !location.hash.startsWith("#task=") ? Promise.resolve() : openLink(location.hash))
  .catch(failed)
  .finally(() => (app.linkOpened = true));
