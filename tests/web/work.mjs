// Work is kept: through reloads, links over it, in other tabs: node work.mjs ADDRESS FOLDER
import { join } from "node:path";
import { launch, linkToLife, openPage, tools } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
const { page, problems } = await openPage(context, address);
const { text, until, ready, said, settled, state, edit, applied, paint } = tools(page);
const seen = {};

// A reload loses nothing: neither the world, nor a text with a mistake, nor settings.
const whole = () =>
  page.evaluate(() => {
    const { edits, element, engine, named, start } = powderdsl;
    const { files, off, shown } = edits.moment();
    const { ids, fields, clock } = engine.snapshot();
    const values = [...fields.values()].map((one) => one.values.join());
    const speed = document.getElementById("speed").value;
    return JSON.stringify([files, off, shown, ids.join(), values, clock.map(String), engine.values, named, start.ids.join(), element, speed]);
  });
await page.locator("#run").click();
await ready();
await said("problems", /No mistakes/);
await page.locator("#packs button", { hasText: "sand" }).click();
await edit("density: 4", "density: 5");
await applied();
await edit("density: 5", "densit: 5");
await until(() => powderdsl.edits.checkTook !== null);
await page.locator("[data-panel=parameters]").click();
await page.locator("#parameters input").first().fill("0.25");
await page.locator("[data-panel=rules-panel]").click();
await page.locator("#speed").fill("3");
await paint(0.3, 0.3);
const kept = await whole();
await page.reload();
await until(() => globalThis.powderdsl?.firstWorld);
seen.module = await page.evaluate(() => powderdsl.compiled);
await ready();
await until(() => powderdsl.edits.diagnostics.length);
seen.reloaded = (await whole()) === kept;
seen.back = await text("status");
await edit("densit: 5", "density: 5");
await applied();

// A link over it: the work is in the list, and Back returns to it.
await page.locator("#step").click();
const before = await whole();
const same = async () => (await whole()) === before;
const link = await linkToLife(browser, address, true);
await page.evaluate((hash) => (location.hash = hash), link);
await said("status", /world of the link/);
seen.link = [await text("status"), (await state()).key];
await page.screenshot({ path: join(folder, "link.png") });
await page.goBack();
await said("status", /This is your earlier work/);
seen.wentBack = await same();
// It comes back where the address has changed since it was kept, too: the page was ended before it could keep that.
await page.evaluate(() => [(powderdsl.save = null), history.replaceState(history.state, "", "#changed")]);
await page.reload();
await ready();
seen.changed = await same();
await page.goForward();
await until(() => powderdsl.rules.key === "life");
await page.locator("#recent summary").click();
await page.locator("#recent div button").first().waitFor();
await page.screenshot({ path: join(folder, "recent.png") });
seen.recent = await page.locator("#recent span").first().innerText();
await page.locator("#recent div button").first().click();
await said("status", /your work of/);
seen.fromList = await same();
await page.locator("#undo").click();
await settled();
seen.undoneLink = (await state()).key;
await page.locator("#redo").click();
await settled();
const again = await page.context().newPage();
await page.close({ runBeforeUnload: true });
await again.waitForTimeout(300);
await again.goto(address);
await again.waitForFunction(() => globalThis.powderdsl?.firstWorld);
seen.newTab = await again.locator("#status").textContent();
seen.problems = problems;
console.log(JSON.stringify(seen, null, 1));
await browser.close();
