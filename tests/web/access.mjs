// Phones, keyboards and eyes: node access.mjs ADDRESS FOLDER
// Pictures go to FOLDER; what axe and the measurements found is printed as JSON.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { launch } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const AXE = readFileSync(fileURLToPath(import.meta.resolve("axe-core/axe.min.js")), "utf8");
const SIZES = [[1440, 900], [768, 1024], [390, 844], [360, 640], [844, 390]];
const PANELS = ["rules-panel", "parameters", "checks", "gallery", "tasks"];
const browser = await launch();
const seen = { violations: [], small: {}, wide: [], reach: {} };
const problems = [];

async function open({ tour = false, ...options }, path = "play.html") {
  const context = await browser.newContext({ bypassCSP: true, ...options });
  await context.route("**/worker.js", () => {}); // nothing here waits for Python, which takes seconds in each context
  const page = await context.newPage();
  if (!tour) await page.addInitScript(() => localStorage.setItem("toured", "yes"));
  page.on("pageerror", (error) => problems.push(String(error)));
  await page.goto(address + path);
  if (path.startsWith("play")) await page.waitForFunction(() => globalThis.powderdsl?.linkOpened && powderdsl.firstPicture, null, { timeout: 60_000 });
  return page;
}

/** What axe finds, with the place where it was found. */
async function check(page, where, part = "html") {
  await page.evaluate(AXE);
  await page.evaluate(() => Promise.allSettled(document.getAnimations().map((one) => one.finished))); // colors change over 0.1 s
  const found = await page.evaluate(async (one) => (await axe.run(one, { resultTypes: ["violations"] })).violations, part);
  for (const { id, nodes } of found) seen.violations.push(`${where}: ${id}: ${nodes.slice(0, 3).map((one) => one.target.join(" ")).join(", ")}`);
}

/** Buttons and fields that are smaller than a finger; the words of a checkbox count. */
const small = (page, inside = "") =>
  page.evaluate((within) =>
    [...document.querySelectorAll(`${within}:is(button, select, summary, input, a[href])`)]
      .filter((one) => one.checkVisibility({ visibilityProperty: true }) && one.id !== "file")
      .map((one) => [one, (one.type === "checkbox" ? one.closest("label") : one).getBoundingClientRect()])
      .filter(([, { width, height }]) => width < 40 || height < 40)
      .map(([one, { width, height }]) => `${one.id || one.textContent || one.ariaLabel} ${Math.round(width)}×${Math.round(height)}`),
    inside,
  );

for (const colorScheme of ["light", "dark"])
  for (const [width, height] of SIZES) {
    const where = `${width} ${colorScheme}`;
    const phone = width < 700 || height < 500;
    const page = await open({ viewport: { width, height }, colorScheme, tour: true, hasTouch: phone, isMobile: phone });
    await page.locator("#tour").waitFor();
    for (const step of [1, 2, 3]) {
      await check(page, `${where} tour ${step}`, "#tour");
      await page.screenshot({ path: join(folder, `${width}-${colorScheme}-tour-${step}.png`) });
      await page.locator("#tour button").first().click();
    }
    for (const panel of PANELS) {
      if (panel !== "rules-panel" || phone) await page.locator(`[data-panel=${panel}]`).click();
      if (panel === "gallery") await page.locator(".card").first().waitFor();
      if (panel === "tasks") await page.locator("#tasks .wide", { hasText: "ice-bridge" }).click();
      if (panel === "tasks") await page.locator("#tasks table").waitFor();
      await check(page, `${where} ${panel}`, panel === "rules-panel" ? "html" : "#side"); // the rest stays as it is
      if (phone && colorScheme === "light") seen.small[`${where} ${panel}`] = await small(page);
    }
    if (phone) {
      await page.locator("[data-panel=tasks]").click(); // closes the sheet
      await page.locator("#tasks table").waitFor({ state: "hidden" });
      seen.reach[where] = await page.evaluate(() => ["canvas", "run", "elements", "tool", "tabs"].filter((id) => {
        const { top, bottom, left } = document.getElementById(id).getBoundingClientRect();
        return top < 0 || left < 0 || left + 40 > innerWidth || (id === "elements" && innerHeight < 500 ? top + 84 : bottom) > innerHeight;
      }));
    } else {
      await page.locator("#keys-button").click();
      await check(page, `${where} keys`);
      await page.keyboard.press("Escape");
    }
    await page.locator("#rules-of").click();
    await check(page, `${where} mentions`, "#mentions");
    await page.locator("#mentions button", { hasText: "Close" }).click();
    if (phone) await page.locator("[data-panel=rules-panel]").click();
    const dialogs = [["new", () => page.locator("#new-element").click()], ["universe", () => page.locator("#rules").selectOption("universe…")]];
    for (const [name, show] of dialogs) {
      await show();
      await page.locator(`#${name}`).waitFor();
      await check(page, `${where} ${name}`, `#${name}`);
      if (phone && colorScheme === "light") seen.small[`${where} ${name}`] = await small(page, `#${name} `);
      await page.screenshot({ path: join(folder, `${width}-${colorScheme}-${name}.png`) });
      await page.keyboard.press("Escape");
    }
    await page.locator("#save summary").click();
    await check(page, `${where} menu`);
    await page.keyboard.press("Escape");
    if (await page.evaluate(() => document.documentElement.scrollWidth > innerWidth)) seen.wide.push(where);
    await page.screenshot({ path: join(folder, `${width}-${colorScheme}.png`) });
    await page.context().close();
  }
for (const colorScheme of ["light", "dark"]) {
  const landing = await open({ viewport: { width: 390, height: 844 }, colorScheme }, "");
  await check(landing, `landing ${colorScheme}`);
  await landing.context().close();
}

// One finger paints; a second one takes that back, and two of them zoom the world and move it.
const page = await open({ viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true });
if (await page.evaluate(() => powderdsl.running)) await page.locator("#run").tap();
await page.locator("#world").selectOption("empty");
const session = await page.context().newCDPSession(page);
const fingers = (type, ...points) => session.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
const count = () => page.evaluate(() => powderdsl.engine.counts()[powderdsl.engine.elements.find((one) => one.qualified === powderdsl.element).id]);
const box = await page.locator("#canvas").boundingBox();
const at = (x, y) => [box.x + box.width * x, box.y + box.height * y];
const before = await count();
await fingers("touchStart", at(0.4, 0.5));
const one = await count();
await fingers("touchStart", at(0.4, 0.5), at(0.6, 0.5));
const two = await count();
await fingers("touchMove", at(0.3, 0.5), at(0.7, 0.5));
await fingers("touchEnd");
const zoomed = await page.locator("#canvas").boundingBox();
await fingers("touchStart", at(0.5, 0.5));
await fingers("touchEnd");
seen.fingers = {
  painted: one > before,
  undone: two === before,
  factor: Math.round((100 * zoomed.width) / box.width) / 100,
  middle: Math.round(zoomed.x + zoomed.width / 2 - box.x - box.width / 2),
  paints: await page.evaluate(() => {
    const { engine, element } = powderdsl;
    return engine.byId.get(engine.ids()[32 * 64 + 32]).qualified === element;
  }),
};

// A dark world is dark, and all of its elements are told from its ground.
await page.locator("#dark").check();
seen.dark = await page.evaluate(() => {
  const { colors, engine } = powderdsl;
  const sum = (color) => [1, 3, 5].reduce((total, i) => total + parseInt(color.slice(i, i + 2), 16), 0);
  const ground = sum(colors.get(engine.ground));
  return { ground, least: Math.min(...[...colors].filter(([id]) => id !== engine.ground).map(([, color]) => sum(color) - ground)) };
});
await page.context().close();

// Pages of people who want no motion wait for them.
const still = await open({ reducedMotion: "reduce" });
await still.waitForTimeout(300);
seen.still = await still.evaluate(() => [powderdsl.running, Number(powderdsl.engine.clock()[2])]);

console.log(JSON.stringify({ ...seen, problems }, null, 1));
await browser.close();
