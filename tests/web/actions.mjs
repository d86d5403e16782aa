// Random actions over every control, and reloads that must lose nothing: node actions.mjs ADDRESS [COUNT [SEED [SLOWER]]]
import { launch, linkToLife, openPage, tools } from "./browser.mjs";

const [address, number = "500", seed = "1", slower = "1"] = process.argv.slice(2);
const count = Number(number);
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
const { page, problems } = await openPage(context, address, { before: prepare });
await (await context.newCDPSession(page)).send("Emulation.setCPUThrottlingRate", { rate: Number(slower) });
page.on("console", (message) => /^powderdsl: /.test(message.text()) && problems.push(message.text())); // nothing is kept, or nothing comes back
const { until } = tools(page);
const seen = { actions: 0, kinds: {}, reloads: 0, lost: [], heap: [], last: [] };

/** Puts a function into the page that does something at random. */
function prepare() {
  HTMLCanvasElement.prototype.setPointerCapture = () => {}; // these pointers are none
  let state = 0;
  const below = (n) => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return Math.floor((state / 2 ** 32) * n);
  };
  const one = (list) => list[below(list.length)];
  const $ = (id) => document.getElementById(id);
  const event = (target, ...names) => names.forEach((name) => target.dispatchEvent(new Event(name, { bubbles: true })));
  const KEYS = [" ", ".", "r", "b", "e", "f", "w", "v", "[", "]", "1", "3", "9", "Escape", "Tab", "F2", "ArrowRight", "Enter", "z", "z", "z", "Z"];
  const press = (key) => {
    const target = document.activeElement ?? document.body;
    const command = /z/i.test(key);
    target.dispatchEvent(new KeyboardEvent("keydown", { key, ctrlKey: command, shiftKey: key === "Z", bubbles: true, composed: true }));
  };
  const stroke = () => {
    const box = $("canvas").getBoundingClientRect();
    const buttons = { button: one([0, 0, 0, 2]), altKey: below(12) === 0, pointerId: 1, bubbles: true };
    const at = () => ({ clientX: box.left + below(box.width + 20) - 10, clientY: box.top + below(box.height + 20) - 10 });
    const send = (name) => $("canvas").dispatchEvent(new PointerEvent(name, { ...buttons, ...at() }));
    send("pointerdown");
    for (let n = below(4); n > 0; n--) send("pointermove");
    if (below(20)) send("pointerup");
  };
  const TEXTS = ["# a\n", "density: 5", "x", "  ", "pack: q", "-> sand", "\n", "gravity: yes", "about: <b>", "needs: core\n"];
  const write = () => {
    const { editor } = powderdsl.edits;
    const { length } = editor.view.state.doc;
    const from = below(length + 1);
    const to = Math.min(length, from + one([0, 0, 1, 9]));
    editor.view.dispatch({ changes: { from, to, insert: below(4) ? one(TEXTS) : "" } });
  };
  const mend = () => {
    const { files } = powderdsl.edits;
    const site = powderdsl.rules.files;
    powderdsl.edits.exchange(Object.fromEntries(Object.keys(files).filter((name) => name in site).map((name) => [name, site[name]])));
  };
  const drop = () => {
    const data = new DataTransfer();
    const files = [["red.yaml", "pack: red\nelements:\n  red: {color: '#f00'}\n"], ["lab.yaml", `ruleset: lab\npacks: [core, ${one(["sand", "zzz"])}]\n`], ["bad.npz", "x"], ["bad name.yaml", ""], ["a.powder", "y"]];
    for (let n = below(3); n >= 0; n--) data.items.add(new File([one(files)[1]], one(files)[0]));
    dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
  };
  const NAMES = ["red", "sand", "my_pack", "", "9", "a b", "core"];
  const use = () => {
    const skipped = "a, #file, #open, #save-gif, #save-webm, #save-world, #save-rules, #gallery button";
    const within = document.querySelector("dialog:modal") ?? document; // nobody reaches what lies behind it
    const all = [...within.querySelectorAll("button, select, input, summary")];
    const target = one(all.filter((each) => each.checkVisibility() && !each.disabled && !each.matches(skipped)));
    if (target.matches("#checks button, [data-tool=look]") && below(10)) return "nothing"; // they take the compiler seconds
    if (target.id === "rules" && below(3)) return "nothing";
    if (target.tagName === "SELECT") {
      const options = [...target.options].filter((each) => !/^(256|512)/.test(each.value) || below(20) === 0);
      target.value = one(options).value;
      event(target, "change");
    } else if (target.type === "range") {
      target.value = String(Number(target.min) + Math.random() * (target.max - target.min));
      event(target, "input", "change");
    } else if (target.type === "number") {
      target.value = one(["0", "7", "-1", "1e9", "99999999999", "1.5", "", "200"]);
      event(target, "input", "change");
    } else if (target.matches("input:not([type=checkbox], [type=color])")) {
      target.value = one(NAMES);
      target.blur();
    } else target.click();
    return `${target.tagName} ${target.id || target.ariaLabel || target.textContent.slice(0, 20)}`;
  };
  // A link of another page, and the way back.
  const visited = () => Number(sessionStorage.getItem("visited"));
  const visit = () => {
    if (visited() && below(2)) {
      sessionStorage.setItem("visited", String(visited() - 1));
      history.back();
      return new Promise((resolve) => addEventListener("popstate", () => resolve("visit"), { once: true }));
    } else if (location.hash !== globalThis.link) {
      sessionStorage.setItem("visited", String(visited() + 1));
      location.hash = globalThis.link;
    }
  };
  const DEEDS = { use, stroke, press: () => press(one(KEYS)), write, mend, drop, visit };
  const CHANCES = ["use", "use", "use", "use", "use", "use", "stroke", "stroke", "stroke", "press", "press", "write", "mend", "drop", "visit"];
  globalThis.deed = async (begin) => {
    state = begin;
    const name = one(CHANCES);
    if (["write", "mend", "drop", "visit"].includes(name) && !powderdsl.linkOpened) return "nothing";
    return (await DEEDS[name]()) || name;
  };
  // Requests, swaps, checks and the acts of tasks go on after an action: nothing of them for a second means that it is over.
  const { fetch } = globalThis;
  let [requests, last, since] = [0, "", 0];
  globalThis.fetch = (...asked) => {
    requests++;
    return fetch(...asked).finally(() => requests--);
  };
  globalThis.isOver = () => {
    const { compilerReady, edits, engine, running, swapping, work } = powderdsl;
    const isChecked = !edits || edits.checkTook !== null || !compilerReady;
    const now = !requests && !swapping && isChecked && (history.state?.work ?? work) === work && `${running || engine.clock()} ${work}`;
    if (now !== last) [last, since] = [now, performance.now()];
    return now && performance.now() - since > 1000;
  };
  globalThis.whole = () => {
    const { edits, element, engine, named, opened, rules, start } = powderdsl;
    const { files, off, shown } = edits?.moment() ?? opened ?? {};
    const { ids, fields, clock } = engine.snapshot();
    const hash = (values) => new Uint8Array(values.buffer, values.byteOffset, values.byteLength).reduce((found, each) => Math.imul(found ^ each, 0x01000193) >>> 0, 0x811c9dc5);
    const values = [...fields.values()].map((each) => hash(each.values));
    return { rules: rules.key, files, off, shown, ids: hash(ids), values, clock: clock.map(String), parameters: engine.values, named, start: hash(start.ids), element };
  };
}

const link = await linkToLife(browser, address);

let state = Number(seed);
const sitting = Math.max(100, Math.floor(count / 10));
while (seen.actions < count && !seen.lost.length && !problems.length) {
  await page.evaluate((hash) => (globalThis.link = hash), link);
  for (let n = 0; n < sitting; n++) {
    state = (Math.imul(state, 22695477) + 1) >>> 0;
    const done = await page.evaluate(async (begin) => {
      const kind = await deed(begin);
      await new Promise((resolve) => setTimeout(resolve, begin % 30));
      return kind;
    }, state);
    seen.actions++;
    seen.last = [...seen.last.slice(-40), done];
    const kind = done.split(" ")[0];
    seen.kinds[kind] = (seen.kinds[kind] ?? 0) + 1;
    if (problems.length) break;
  }
  await until(() => isOver());
  const before = await page.evaluate(() => {
    if (powderdsl.running) document.getElementById("run").click();
    gc();
    return { ...whole(), heap: performance.memory.usedJSHeapSize };
  });
  seen.heap.push(Math.round(before.heap / 2 ** 20));
  await page.reload();
  await page.waitForFunction(() => globalThis.powderdsl?.firstWorld && powderdsl.edits && powderdsl.linkOpened, null, { timeout: 60000 });
  const after = await page.evaluate(() => whole());
  for (const name of Object.keys(after)) {
    const [old, now] = [before[name], after[name]].map((each) => JSON.stringify(each));
    const isKept = name === "files" ? Object.entries(before.files ?? {}).every(([file, content]) => after.files[file] === content) : old === now;
    if (!isKept && before.files) seen.lost.push([name, String(old).slice(0, 300), String(now).slice(0, 300)]);
  }
  seen.reloads++;
}
if (!seen.lost.length && !problems.length) seen.last = [];
seen.problems = problems;
console.log(JSON.stringify(seen));
await browser.close();
