// Looks at an exported site as visitors do: node views.mjs ADDRESS FOLDER
// Pictures and downloads go to FOLDER; what was seen is printed as JSON.
import { join } from "node:path";
import { launch, openPage } from "./browser.mjs";

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
  const { Painter, Screen } = await import("./view.js");
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
    const drawn = new Uint8Array(4 * engine.cells);
    screen.gl.readPixels(0, 0, columns, rows, screen.gl.RGBA, screen.gl.UNSIGNED_BYTE, drawn);
    const wanted = one.draw(tint).data;
    const row = 4 * columns;
    found[name] = wanted.filter((value, at) => value !== drawn[(rows - 1 - Math.floor(at / row)) * row + (at % row)]).length;
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

seen.problems = problems.flat().filter((one) => !/GPU stall/.test(one));
console.log(JSON.stringify(seen, null, 1));
await browser.close();
