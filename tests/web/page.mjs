// Uses the playground as people do, in headless Chromium: node page.mjs ADDRESS FOLDER
// Pictures and downloads go to FOLDER; what was seen is printed as JSON.
import { join } from "node:path";
import { launch, openPage, replaceText as edit } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const browser = await launch();
const requests = new Set();

const ready = (page) =>
  page.waitForFunction(() => powderdsl.compilerReady && powderdsl.linkOpened, null, { timeout: 60000 });
const passed = (page, from, steps) =>
  page.waitForFunction((until) => powderdsl.engine.clock()[2] >= BigInt(until), from + steps);

/** A hash (FNV-1a) of the ids and of a field of the world, and its step. */
const hashes = (page, field) =>
  page.evaluate((name) => {
    const fnv = (data) => {
      let found = 0x811c9dc5;
      for (const byte of new Uint8Array(data.buffer)) found = Math.imul(found ^ byte, 0x01000193) >>> 0;
      return found;
    };
    const { ids, fields, clock } = powderdsl.engine.snapshot();
    return { ids: fnv(ids), field: fnv(fields.get(name).values), step: Number(clock[2]) };
  }, field);
const count = (page, name) =>
  page.evaluate((one) => {
    const { engine } = powderdsl;
    return engine.counts()[engine.elements.find((each) => each.name === one).id];
  }, name);
const text = (page, id) => page.locator(`#${id}`).textContent();
const step = (page) => page.evaluate(() => Number(powderdsl.engine.clock()[2]));
const said = (page, id, pattern) =>
  page.waitForFunction(
    ([name, source]) => new RegExp(source).test(document.getElementById(name).textContent),
    [id, pattern.source],
    { timeout: 60000 },
  );

const until = (page, what) =>
  page.waitForFunction((name) => powderdsl.edits[name] !== null, what, { timeout: 60000 });

async function drag(page, from, to) {
  const box = await page.locator("#canvas").boundingBox();
  const place = ([x, y]) => [box.x + box.width * x, box.y + box.height * y];
  await page.mouse.move(...place(from));
  await page.mouse.down();
  await page.mouse.move(...place(to), { steps: 12 });
  await page.mouse.up();
}

async function downloaded(page, name, action) {
  const waiting = page.waitForEvent("download");
  await action();
  await (await waiting).saveAs(join(folder, name));
}

const saved = (page, id, name) =>
  downloaded(page, name, async () => {
    await page.locator("#save summary").click();
    await page.locator(`#${id}`).click();
  });

const seen = {};
const { page, problems } = await openPage(browser, address);
page.on("request", (one) => requests.add(new URL(one.url()).origin));
page.on("dialog", (one) => one.accept());

// While the compiler loads: paint sand and see it fall; undo; drag wind.
await page.locator("#run").click();
await page.locator("#speed").fill("8");
await page.locator("#world").selectOption("empty");
const clean = await hashes(page, "wind.velocity");
await page.locator("#elements button", { hasText: "sand" }).click();
await drag(page, [0.3, 0.2], [0.7, 0.2]);
seen.painted = await count(page, "sand");
const low = () =>
  page.evaluate(() => {
    const { engine } = powderdsl;
    const sand = engine.elements.find((one) => one.name === "sand").id;
    return engine.ids().subarray(-2 * engine.columns).filter((one) => one === sand).length;
  });
seen.lyingBefore = await low();
await page.locator("#undo").click();
const undone = await hashes(page, "wind.velocity");
seen.undone = undone.ids === clean.ids && undone.step === clean.step;
await page.locator("#redo").click();
seen.redone = await count(page, "sand");
await page.locator("#run").click();
await passed(page, 0, 100);
await page.locator("#run").click();
seen.lyingAfter = await low();
seen.fallen = await count(page, "sand");
await page.keyboard.press("w");
await drag(page, [0.2, 0.5], [0.8, 0.5]);
seen.wind = await page.evaluate(() => {
  const { engine } = powderdsl;
  return Math.max(...engine.field(engine.motion).subarray(engine.cells));
});
await page.keyboard.press("b");

// The same with the keyboard alone.
const focused = () => page.evaluate(() => document.activeElement.textContent);
await page.locator("[data-tool=brush]").focus();
seen.keyboard = [];
for (const one of ["ArrowRight", "Home"]) {
  await page.keyboard.press(one);
  seen.keyboard.push(await focused(), await page.evaluate(() => powderdsl.tool));
}
await page.locator("#elements [tabindex='0']").focus();
await page.keyboard.press("ArrowRight");
seen.keyboard.push(await focused(), await page.evaluate(() => powderdsl.element));
await page.locator("#canvas").focus();
const dry = await count(page, "water");
for (const one of ["Shift+ArrowUp", "Shift+ArrowUp", "Enter"]) await page.keyboard.press(one);
seen.keyboard.push((await count(page, "water")) > dry);
await page.keyboard.press("Control+z");
seen.keyboard.push((await count(page, "water")) === dry);

// Break a rule, see where and why; fix it, and see the world continue.
await ready(page);
await said(page, "problems", /No mistakes/);
const before = await hashes(page, "wind.velocity");
await edit(page, "density: 4", "densit: 4");
await until(page, "checkTook");
seen.problem = await text(page, "problems");
await page.locator("#run").click();
await passed(page, before.step, 6);
seen.ranWhileBroken = (await step(page)) - before.step;
await edit(page, "densit: 4", "density: 2");
await until(page, "applyTook");
seen.applied = await text(page, "status");
seen.stepsAfterFix = (await step(page)) - before.step;
seen.sandAfterFix = await count(page, "sand");

// A pack of one's own.
await page.locator("#packs button", { hasText: "+ pack" }).click();
await until(page, "applyTook");
seen.own = await page.locator("#elements button", { hasText: "mine" }).count();
await page.locator("#run").click();

// A link opens the same world, with the same rules, while this page goes on.
await page.locator("#share").click();
await page.waitForFunction(() => location.hash.length > 10);
seen.link = page.url().length;
const here = await hashes(page, "wind.velocity");
const second = await openPage(browser, page.url(), { before: () => delete globalThis.VideoEncoder });

// Save the world and its rules: the status line says how they continue.
await saved(page, "save-world", "own/world.npz");
await page.locator("#status code").waitFor();
seen.command = await page.locator("#status code").textContent();
await downloaded(page, "own/rules.zip", () => page.locator("#status button", { hasText: "rules.zip" }).click());
await page.locator("#save summary").click();
await page.locator("#save-rules", { hasText: "(.zip)" }).waitFor({ state: "visible" });
seen.entries = await page.locator("#save div").innerText();
await page.keyboard.press("Escape");
for (let i = 0; i < 5; i++) await page.locator("#step").click();
seen.ownContinued = await hashes(page, "wind.velocity");

// The shipped rules again: a world continues on the command line.
await page.locator("#rules").selectOption("powderworld");
await page.waitForFunction(() => !powderdsl.edits.edited && powderdsl.running);
await passed(page, 0, 200);
await page.screenshot({ path: join(folder, "page.png") });
await page.evaluate(() => powderdsl.recorder.clear());
await passed(page, await step(page), 240);
await page.locator("#run").click();
await page.keyboard.press("w");
await drag(page, [0.2, 0.3], [0.8, 0.35]); // moving cells are tinted
await said(page, "problems", /No mistakes/);
await saved(page, "save-world", "world.npz");
for (let i = 0; i < 20; i++) await page.keyboard.press(".");
seen.continued = await hashes(page, "wind.velocity");
await saved(page, "save-png", "world.png");
await saved(page, "save-gif", "world.gif");
await saved(page, "save-webm", "world.webm");

// Why a cell changed, and what is known about the rules.
await page.keyboard.press("t");
const box = await page.locator("#canvas").boundingBox();
await page.mouse.click(box.x + box.width * 0.25, box.y + box.height * 0.8);
await said(page, "checks", /of powderworld/);
await page.locator("#checks button", { hasText: "ledger" }).click();
await said(page, "checks", /ledger of/);
seen.checks = await text(page, "checks");

await ready(second.page);
seen.sameFromLink = JSON.stringify(await hashes(second.page, "wind.velocity")) === JSON.stringify(here);
seen.ownFromLink = await second.page.locator("#elements button", { hasText: "mine" }).count();
await second.page.locator("#save summary").click();
seen.noVideo = [await second.page.locator("#save-webm").isDisabled(), await text(second.page, "no-video")];
await second.page.close();

// A stranger's link: damaged, or with HTML in it.
for (const bad of ["#w=AAAA", "#w=%3Cscript%3E", `#w=${"A".repeat(5000)}`]) {
  await page.evaluate((hash) => (location.hash = hash), bad);
  await said(page, "status", /damaged|version/);
}
await page.locator("[data-panel=rules-panel]").click();
await edit(page, "about: A powder that falls and piles up.", 'about: "<img src=x onerror=alert(1)>" \nnot <b>rules</b>');
await until(page, "checkTook");
seen.htmlInserted = await page.evaluate(() => document.querySelectorAll("#problems img, #problems b, #status img").length);
seen.htmlShown = (await text(page, "problems")).includes("<b>");

// The gallery, and narrow screens.
await page.locator("[data-panel=gallery]").click();
await page.locator("#gallery .card").first().waitFor();
seen.gallery = await page.locator("#gallery .card").count();
await page.setViewportSize({ width: 360, height: 740 });
seen.tooWide = await page.evaluate(() => document.documentElement.scrollWidth > innerWidth);
seen.problems = [...problems, ...second.problems];
seen.origins = [...requests].filter((one) => one !== new URL(address).origin && one !== "null");
console.log(JSON.stringify(seen, null, 1));
await browser.close();
