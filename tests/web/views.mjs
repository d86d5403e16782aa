// Looks at an exported site as visitors do: node views.mjs ADDRESS FOLDER
// Pictures and downloads go to FOLDER; what was seen is printed as JSON.
import { join } from "node:path";
import { launch, openPage, replaceText } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const browser = await launch();
const seen = {};
const problems = [];
const open = async (path, options) => {
  const found = await openPage(browser, address + path, options);
  problems.push(found.problems);
  return found.page;
};

// The landing page has a card and a picture for each of the rules, which open in the playground.
const landing = await browser.newPage();
await landing.goto(address);
await landing.locator(".card img").last().scrollIntoViewIfNeeded();
await landing.waitForFunction(() => [...document.images].every((one) => one.naturalWidth > 0));
seen.cards = await landing.locator(".card strong").allTextContents();
await landing.locator(".card").last().click();
await landing.waitForFunction(() => globalThis.powderdsl?.firstPicture);
seen.opened = await landing.evaluate(() => powderdsl.rules.key);
await landing.close();

// An embedded world has a button, a link, and no compiler.
const embedded = await open("play.html?rules=life&embed", { viewport: { width: 420, height: 420 } });
await embedded.waitForFunction(() => powderdsl.firstPicture);
seen.embedded = {
  shown: await embedded.locator("button:visible, a:visible, select:visible").allTextContents(),
  link: (await embedded.locator("#full").getAttribute("href")).replace(address, ""),
  editor: await embedded.evaluate(() => Boolean(powderdsl.edits)),
};
await embedded.close();

// The GPU draws what the processor draws, also where cells of all elements move.
const page = await open("play.html");
seen.pixels = await page.evaluate(async () => {
  const { Painter, Screen, image } = await import("./view.js");
  const { generator } = await import("./engine.js");
  const { engine } = powderdsl;
  const { rows, columns } = engine;
  powderdsl.running = false;
  const random = generator(1);
  engine.begin(engine.ids().map(() => engine.elements[Math.floor(random() * engine.elements.length)].id), 0);
  const field = engine.field(engine.motion);
  for (let i = 0; i < field.length; i++) field[i] = random() < 0.2 ? 0 : 6 * random() - 3;
  engine.calls.take(engine.motion);
  const found = {};
  const painter = new Painter(engine);
  const ramped = new Painter(engine);
  const { id, color: start } = engine.elements[1];
  ramped.ramps = [{ id, field: engine.motion, ramp: { start, end: "#ffffff", low: 0, high: 3 }, known: new Map() }];
  for (const [name, one, tint] of [["tinted", painter, true], ["plain", painter, false], ["ramped", ramped, true]]) {
    const canvas = Object.assign(document.createElement("canvas"), { width: columns, height: rows });
    const screen = new Screen(canvas, true);
    screen.show(one, tint);
    const drawn = image(screen, one, tint).data;
    found[name] = one.draw(tint).data.filter((value, at) => value !== drawn[at]).length;
  }
  painter.draw(true);
  found.colors = new Set(painter.pixels).size;
  found.without = new Screen(document.createElement("canvas")).gl;
  return found;
});

// One key begins a recording; the list of keys names it.
await page.waitForFunction(() => powderdsl.record && powderdsl.linkOpened);
await page.keyboard.press("?");
seen.keys = await page.locator("#keys").innerText();
await page.locator("#keys button").click();
seen.closed = await page.locator("#keys").isHidden();
await page.locator("#canvas").focus();
await page.keyboard.press("m");
await page.waitForFunction(() => powderdsl.recorder.frames.length > 8);
seen.recording = [await page.evaluate(() => powderdsl.running), await page.locator("#status").textContent()];
const film = page.waitForEvent("download");
await page.keyboard.press("m");
await (await film).saveAs(join(folder, "film.webm"));

// The chart goes on under other rules; its legend has the numbers of the point under the pointer.
const said = (id, pattern) =>
  page.waitForFunction(([one, source]) => new RegExp(source).test(document.getElementById(one).textContent), [id, pattern.source], { timeout: 60_000 });
await page.waitForFunction(() => powderdsl.compilerReady, null, { timeout: 60_000 });
await said("problems", /No mistakes/);
const ruled = await page.evaluate(() => Number(powderdsl.engine.clock()[2]));
await replaceText(page, "density: 4", "density: 2");
await said("status", /The new rules run/);
await page.waitForFunction((step) => powderdsl.engine.clock()[2] > step + 30, ruled);
const chart = await page.locator("#chart").boundingBox();
await page.mouse.move(chart.x + 2, chart.y + 40);
const legend = await page.locator("#legend").innerText();
seen.chart = { earlier: Number(legend.match(/step (\d+)/)[1]) < ruled, legend };
await page.locator("#reset").click();
await page.waitForFunction(() => /step \d$|step [1-9]\d$/.test(document.querySelector("#legend span").textContent));
await page.locator("#undo").click();

// Explain says in a sentence which rule it was, shows the cells around, and leads to the rule.
if (await page.evaluate(() => powderdsl.running)) await page.locator("#run").click();
await page.locator("#world").selectOption("empty");
await page.locator("#elements button", { hasText: "sand" }).click();
const world = await page.locator("#canvas").boundingBox();
const place = (row, column) => [world.x + (world.width * (column + 0.5)) / 64, world.y + (world.height * (row + 0.5)) / 64];
await page.mouse.click(...place(20, 20));
for (let i = 0; i < 3; i++) await page.locator("#step").click();
await page.keyboard.press("t");
await page.mouse.click(...place(25, 20));
await said("checks", /The cell \(/);
seen.why = await page.locator("#checks p").first().innerText();
seen.near = await page.locator("#checks .near canvas").count();
await page.locator("#checks p button").first().click();
seen.rule = await page.evaluate(() => {
  const { view } = powderdsl.edits.editor;
  return [powderdsl.edits.shown, view.state.doc.lineAt(view.state.selection.main.head).text.trim()];
});

// Parameters name the line that uses them; fields that hold elements are set by name.
await page.locator("#tab-parameters").click();
seen.parameters = await page.locator(".parameter", { hasText: "fire.dies" }).innerText();
await page.keyboard.press("v");
await page.locator("#field").selectOption({ label: "clone" });
seen.choices = await page.locator("#choice option").allInnerTexts();
await page.locator("#elements button", { hasText: "cloner" }).click();
await page.mouse.click(...place(40, 40));
await page.keyboard.press("v");
await page.locator("#choice").selectOption({ label: "lava" });
await page.mouse.click(...place(40, 40));
await page.mouse.move(...place(40, 40.2));
seen.set = await page.locator("#hover").getAttribute("title");

// A remix names the work that it came from; an embedded link without edited rules needs no compiler.
await page.locator("#rules").selectOption("life");
await said("status", /Game of Life/);
const links = [];
for (let i = 0; i < 2; i++) {
  await page.locator("#share").click();
  await said("status", /link/);
  links.push(new URL(page.url()).hash);
  const next = await open(`play.html${links[i]}`);
  await next.waitForFunction(() => powderdsl.linkOpened);
  seen.origin = [await next.locator("#status").innerText(), await next.evaluate(() => powderdsl.named.from.length)];
  if (i === 0) {
    await next.locator("#share").click();
    await next.waitForFunction((hash) => location.hash !== hash, links[0]);
    await page.goto(`${address}play.html?again${await next.evaluate(() => location.hash)}`);
    await page.waitForFunction(() => globalThis.powderdsl?.linkOpened);
  }
  await next.close();
}
const framed = await open(`play.html?embed${links[1]}`, { viewport: { width: 420, height: 420 } });
await framed.waitForFunction(() => powderdsl.rules.key === "life" && powderdsl.running);
seen.framed = await framed.evaluate(() => [Boolean(powderdsl.edits), powderdsl.named.from.length]);

seen.problems = problems.flat().filter((one) => !/GPU stall/.test(one));
console.log(JSON.stringify(seen, null, 1));
await browser.close();
