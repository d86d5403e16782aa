// Files and links: what leaves the page, and what comes back in.

import { $, commandLine, failed, make, say } from "./dom.js";
import { Recorder, download, gif, png } from "./media.js";
import { openRules, openWorld } from "./opening.js";
import { addFile, applyRules, openFiles, rules } from "./rules.js";
import { fromFragment, toFragment } from "./share.js";
import { refresh } from "./stage.js";
import { app } from "./state.js";
import { missing, webm } from "./video.js";
import { readWorld, text, writeWorld } from "./worlds.js";

const MAX_FILE = 32 << 20;
const recorder = new Recorder();
app.drawn = (image) => recorder.add(image);
app.recorder = recorder;

/** Parameters whose values are not those of the files. */
function changedParameters() {
  const { parameters, values } = app.engine;
  return Object.fromEntries(parameters.flatMap((one, i) => (values[i] === one.value ? [] : [[one.name, values[i]]])));
}

/** The files that differ from the site's; null for a file of the site that is gone. */
function changedFiles() {
  const found = {};
  for (const [name, content] of Object.entries(rules.files)) {
    if (app.rules.files[name] !== content) found[name] = content;
  }
  for (const name of Object.keys(app.rules.files)) if (!(name in rules.files)) found[name] = null;
  return Object.keys(found).length ? found : null;
}

export async function link() {
  const shared = {
    key: app.rules.key,
    files: changedFiles(),
    off: [...rules.off],
    parameters: Object.fromEntries(app.engine.parameters.map((one, i) => [one.name, app.engine.values[i]])),
    world: app.engine.snapshot(),
  };
  return location.href.split("#")[0] + (await toFragment(shared));
}

async function share() {
  const address = await link();
  history.replaceState(null, "", new URL(address).hash);
  try {
    await navigator.clipboard.writeText(address);
    say(`The link is copied: ${address.length.toLocaleString("en")} characters hold the rules and the world.`);
  } catch {
    say(`The address bar holds the link: ${address.length.toLocaleString("en")} characters.`);
  }
}

/** Opens what a link holds. A world of edited rules waits until they are compiled. */
export async function openLink(fragment) {
  const shared = await fromFragment(fragment);
  if (!shared) return false;
  const { world, files, off, parameters } = shared;
  const listed = app.catalog.rules.find((one) => one.key === shared.key);
  if (!listed) throw new Error(`The link uses the rules ${shared.key}, which this page does not have.`);
  const size = `${world.rows}x${world.columns}`;
  if (!(await openRules(shared.key, { size, run: false }))) return false;
  const own = files === null && String(off) === String(app.rules.off);
  if (!own || !listed.sizes.some((one) => one.join("x") === size)) {
    say("Compiling the rules of the link…");
    const all = { ...app.rules.files, ...files };
    for (const name of Object.keys(all)) if (all[name] === null) delete all[name];
    const found = await openFiles(all, off, Object.keys(files ?? {})[0]);
    rules.edited = !own;
    if (!found?.ok) throw new Error("The rules of the link have mistakes: see the list below the editor.");
    await applyRules(world.rows, world.columns);
  }
  app.engine.parameters.forEach(({ name }, i) => {
    if (Object.hasOwn(parameters, name)) app.engine.setParameter(i, parameters[name]);
  });
  for (const one of app.onEngine) one(app.engine);
  openWorld(world);
  app.history.clear();
  refresh();
  say("This is the world of the link, paused.");
  return true;
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

async function openFile(file) {
  if (!file) return;
  if (file.size > MAX_FILE) throw new Error(`${file.name} is larger than ${MAX_FILE >> 20} MiB.`);
  if (/\.ya?ml$/i.test(file.name)) {
    const name = file.name.replace(/\.yml$/i, ".yaml");
    if (!/^[A-Za-z0-9_][A-Za-z0-9_-]{0,60}\.yaml$/.test(name)) throw new Error(`${file.name}: rename it to letters, digits, _ and -`);
    addFile(name, await file.text());
    return;
  }
  const data = new Uint8Array(await file.arrayBuffer());
  const world = readWorld(await rules.compiler.call("open_world", text(data)));
  if (world.rows !== app.engine.rows || world.columns !== app.engine.columns) await applyRules(world.rows, world.columns);
  openWorld(world);
  say(`${file.name}: ${world.rows}×${world.columns} cells, step ${world.clock[2]}`);
}

const on = (id, action) =>
  $(id).addEventListener("click", () => {
    $("save").open = false;
    Promise.resolve(action()).catch(failed);
  });

on("share", share);
on("save-world", saveWorld);
on("save-pack", () => download(new Blob([rules.files[rules.shown]], { type: "text/yaml" }), rules.shown));
on("save-rules", saveRules);
on("save-png", async () => download(await png($("canvas")), "world.png"));
on("save-gif", () => saveFilm(gif, "world.gif"));
on("save-webm", () => saveFilm(webm, "world.webm"));
$("save").addEventListener("toggle", () => $("save").open && showEntries().catch(failed));
addEventListener("pointerdown", ({ target }) => {
  if (!$("save").contains(target)) $("save").open = false;
});
addEventListener("keydown", ({ key }) => {
  if (key !== "Escape" || !$("save").open) return;
  $("save").open = false;
  $("save").querySelector("summary").focus();
});
missing().then((reason) => {
  $("save-webm").disabled = $("no-video").textContent = reason;
  $("no-video").hidden = !reason;
});
on("open", () => $("file").click());
$("file").onchange = () => {
  openFile($("file").files[0]).catch(failed);
  $("file").value = "";
};
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  openFile(event.dataTransfer?.files[0]).catch(failed);
});
addEventListener("hashchange", () => openLink(location.hash).catch(failed));
openLink(location.hash)
  .catch(failed)
  .finally(() => (app.linkOpened = true));
