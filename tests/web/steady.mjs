// Uses the page at random for some minutes and measures its memory: node steady.mjs ADDRESS [MINUTES] [SEED]
// Prints a line for each minute, measured with the same rules and panel; fails if the median of a measure grows from the
// second to the last third.
import { readFileSync } from "node:fs";
import { launch, openPage } from "./browser.mjs";

const [address, minutes = "5", seed = "1"] = process.argv.slice(2);
/** How much may be added. Python's memory grows by a fifth at once; the others hold what the page keeps up to a limit. */
const GROWTH = { heap: 0.1, nodes: 0.1, listeners: 0.1, python: 0.25 };
const browser = await launch();
const { page, problems } = await openPage(browser, address);
page.on("dialog", (one) => one.accept());
page.on("download", (one) => one.cancel());
await page.waitForFunction(() => powderdsl.compilerReady && powderdsl.linkOpened, null, { timeout: 60000 });

let state = Number(seed);
const below = (n) => {
  state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
  return Math.floor((state / 2 ** 32) * n);
};
const pick = (list) => list[below(list.length)];
const checked = () => page.waitForFunction(() => powderdsl.edits.checkTook !== null, null, { timeout: 60000 });
const settled = () =>
  page.waitForFunction(
    () => powderdsl.edits.applyTook !== null || (powderdsl.edits.checkTook !== null && document.querySelector(".problem.error, .problem[class=problem]")),
    null,
    { timeout: 60000 },
  );
const options = (id) => page.locator(`#${id} option`).evaluateAll((found) => found.map((one) => one.value));
const choose = async (id, wanted) => page.locator(`#${id}`).selectOption(wanted ?? pick(await options(id)));
const click = (id) => page.locator(`#${id}`).click();
const showRules = () => page.locator("[data-panel=rules-panel]").click();

async function stroke() {
  await page.locator(`[data-tool=${pick(["brush", "brush", "erase", "fill", "wind", "field"])}]`).click({ force: true, timeout: 2000 }).catch(() => {});
  await page.locator("#elements button").nth(below(await page.locator("#elements button").count())).click();
  await page.locator("#brush-range").fill(String(1 + below(20)));
  const box = await page.locator("#canvas").boundingBox();
  const place = () => [box.x + (box.width * below(100)) / 100, box.y + (box.height * below(100)) / 100];
  await page.mouse.move(...place());
  await page.mouse.down({ button: pick(["left", "left", "right"]) });
  for (let n = below(4); n >= 0; n--) await page.mouse.move(...place(), { steps: 5 });
  await page.mouse.up();
  await page.mouse.up({ button: "right" });
}

/** Another number in the shown file, or a mistake and its correction. */
async function edit() {
  await showRules();
  const change = (mistake) =>
    page.evaluate((word) => {
      const { view } = powderdsl.edits.editor;
      const found = /density: *\w+/.exec(view.state.doc.toString());
      if (!found) return false;
      const change = { from: found.index, to: found.index + found[0].length, insert: `density: ${word}` };
      view.dispatch({ changes: change });
      return true;
    }, mistake);
  if (below(3) === 0 && (await change("heavy"))) await checked();
  if (await change(String(1 + below(5)))) await settled();
}

const ACTIONS = [
  stroke, stroke, stroke, stroke,
  edit, edit,
  async () => {
    await showRules();
    await page.locator("#packs .pack button").nth(below(await page.locator("#packs .pack").count())).click();
  },
  async () => {
    await showRules();
    const box = page.locator("#packs input").last();
    for (let n = 0; n < 2; n++) {
      await box.click();
      await checked();
    }
  },
  () => click("run"),
  () => page.locator("#speed").fill(String(below(10))),
  () => page.locator("#undo").click({ force: true }),
  () => page.locator("#redo").click({ force: true }),
  () => click("step"),
  () => click("reset"),
  () => choose("world"),
  () => choose("size", pick(["64x64", "64x64", "128x128", "256x256", "512x512"])),
  () => page.locator("#seed").fill(String(below(1000))),
  () => choose("rules", pick(["powderworld", "powderworld", "life", "salt"])),
  () => page.locator(`[data-panel=${pick(["parameters", "checks", "gallery"])}]`).click(),
  () => page.locator("#blind").click(),
  async () => {
    await page.locator("[data-panel=checks]").click();
    await page.locator("#checks button", { hasText: pick(["ledger", "tests"]) }).click();
    await page.waitForFunction(() => ![...document.querySelectorAll("#checks button")].some((one) => one.disabled), null, { timeout: 60000 });
  },
  async () => {
    await page.locator("[data-tool=look]").click();
    const box = await page.locator("#canvas").boundingBox();
    await page.mouse.click(box.x + (box.width * below(100)) / 100, box.y + (box.height * below(100)) / 100);
    await page.waitForFunction(() => !document.getElementById("checks").textContent.includes("Looking for"), null, { timeout: 90000 });
  },
  async () => {
    await page.locator("#save summary").click();
    await page.locator(`#${pick(["save-png", "save-gif", "save-webm", "save-world"])}`).click();
    await page.waitForTimeout(500);
  },
  () => click("share"),
];

const client = await page.context().newCDPSession(page);
await client.send("Performance.enable");
const machine = await browser.newBrowserCDPSession();
const MB = 2 ** 20;
const round = (value) => Math.round(value * 10) / 10;

/** MiB, and counts of nodes and listeners. `resident` is what the page's processes take of the machine. */
async function measure() {
  await choose("rules", "powderworld");
  await showRules();
  await page.waitForFunction(() => !powderdsl.edits.edited && /No mistakes/.test(document.getElementById("problems").textContent), null, { timeout: 90000 });
  await choose("size", "64x64");
  await client.send("HeapProfiler.collectGarbage");
  const { metrics } = await client.send("Performance.getMetrics");
  const of = (name) => metrics.find((one) => one.name === name).value;
  const { processInfo } = await machine.send("SystemInfo.getProcessInfo");
  const pages = processInfo.filter((one) => one.type === "renderer").map((one) => readFileSync(`/proc/${one.id}/statm`, "utf8"));
  const workers = await Promise.all(page.workers().map((one) => one.evaluate(() => globalThis.python?._module.HEAP8.length ?? 0).catch(() => 0)));
  const world = await page.evaluate(() => powderdsl.engine.calls.memory.buffer.byteLength);
  return {
    heap: round(of("JSHeapUsedSize") / MB),
    nodes: of("Nodes"),
    listeners: of("JSEventListeners"),
    python: round(Math.max(0, ...workers) / MB),
    world: round(world / MB),
    resident: round(pages.reduce((sum, one) => sum + Number(one.split(" ")[1]) * 4096, 0) / MB),
  };
}

const seen = [];
let done = 0;
const failures = new Map();
const begun = Date.now();
for (let minute = 1; minute <= Number(minutes); minute++) {
  while (Date.now() - begun < minute * 60_000) {
    try {
      await pick(ACTIONS)();
    } catch (error) {
      const [line] = String(error.message).split("\n");
      failures.set(line, (failures.get(line) ?? 0) + 1);
    }
    done++;
    await page.waitForTimeout(below(200));
  }
  seen.push(await measure());
  console.log(JSON.stringify({ minute, actions: done, ...seen.at(-1) }));
}
const third = Math.max(1, Math.floor(seen.length / 3));
const median = (part, name) => part.map((one) => one[name]).sort((a, b) => a - b)[part.length >> 1];
const before = (name) =>
  // A worker that was stopped begins anew with little memory: its largest counts.
  name === "python" ? Math.max(...seen.slice(0, -third).map((one) => one[name])) : median(seen.slice(-2 * third, -third), name);
const grown = Object.keys(GROWTH).filter((name) => median(seen.slice(-third), name) > (1 + GROWTH[name]) * before(name));
const frames = await page.evaluate(() => powderdsl.frames);
await page.waitForTimeout(500);
const alive = (await page.evaluate(() => powderdsl.frames)) > frames;
console.log(JSON.stringify({ grown, alive, problems, failures: [...failures] }));
await browser.close();
process.exitCode = grown.length || !alive || problems.length ? 1 : 0;
