// A first visit, elements of one's own, and universes: node first.mjs ADDRESS FOLDER
import { join } from "node:path";
import { launch, openPage, tools } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
const seen = {};

// Three steps, which the keyboard reaches and ends, and which no later visit shows.
const first = await openPage(context, `${address}play.html`, { tour: true });
const { page, problems } = first;
const { until, ready, said, applied, files, text } = tools(page);
const tour = page.locator("#tour");
await tour.waitFor();
await page.locator("#share").focus();
await page.keyboard.press("Tab");
seen.steps = [await tour.innerText()];
await page.screenshot({ path: join(folder, "tour-1.png") });
seen.focused = await page.evaluate(() => document.activeElement.closest("#tour") !== null);
for (const number of [2, 3]) {
  await page.keyboard.press("Enter");
  seen.steps.push(await tour.innerText());
  await page.screenshot({ path: join(folder, `tour-${number}.png`) });
}
await page.keyboard.press("Enter");
seen.ended = await tour.isHidden();
seen.docs = (await (await page.request.get(new URL(await page.locator("footer a").first().getAttribute("href"), page.url()).href)).text()).split("\n")[0];
const shown = async (path) => {
  const { page: later } = await openPage(context, address + path, { tour: true });
  await later.waitForFunction(() => powderdsl.linkOpened || document.body.matches(".embed"));
  await later.waitForTimeout(300);
  const isShown = await later.locator("#tour").isVisible();
  await later.close();
  return isShown;
};
seen.later = [await shown("play.html?rules=life")];
await page.evaluate(() => localStorage.clear());
seen.later.push(await shown("play.html?embed"), await shown("play.html?rules=life"));
const { page: phone } = await openPage(browser, `${address}play.html?phone`, { tour: true, viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true });
await phone.locator("#tour").waitFor();
for (const number of [1, 2, 3]) {
  await phone.screenshot({ path: join(folder, `tour-phone-${number}.png`) });
  if (number < 3) await phone.locator("#tour button").first().tap();
}
seen.sheet = await phone.locator("#rules-panel").isVisible();
await phone.keyboard.press("Escape");
seen.escaped = [await phone.locator("#tour").isHidden(), await phone.evaluate(() => localStorage.getItem("toured"))];
await phone.close();

// The editor opens on a rule; a button lists the lines about an element.
await ready();
await said("problems", /No mistakes/);
const cursor = () => page.evaluate(() => {
  const { editor, shown } = powderdsl.edits;
  const { doc, selection } = editor.view.state;
  return [shown, doc.lineAt(selection.main.head).text.trim()];
});
seen.rule = await cursor();
await page.locator("#elements button", { hasText: "ice" }).click();
await page.locator("#rules-of").click();
seen.mentions = await page.locator("#mentions > button").allInnerTexts();
await page.locator("#mentions > button", { hasText: "water -> ice" }).click();
seen.mentioned = await cursor();
await page.screenshot({ path: join(folder, "mentions.png") });
await page.locator("#mentions button", { hasText: "Close" }).click();

// A form writes the pack of a new element.
await page.locator("#new-element").click();
const form = page.locator("#new");
await form.locator("[name=name]").fill("sand");
seen.taken = await form.locator("[name=name]").evaluate((one) => one.validationMessage);
await form.locator("[name=name]").fill("goo");
await form.locator("[name=moves]").selectOption("flows");
await form.locator("[name=other]").selectOption({ label: "sand" });
await form.locator("[name=self]").selectOption({ label: "empty" });
await form.locator("[name=that]").selectOption({ label: "water" });
await page.screenshot({ path: join(folder, "new.png") });
await form.locator("button", { hasText: "Write" }).click();
await applied();
seen.written = await page.evaluate(() => [powderdsl.edits.shown, powderdsl.edits.files["goo.yaml"], powderdsl.element, powderdsl.edits.diagnostics.filter((one) => one.severity !== "note").length]);
await page.screenshot({ path: join(folder, "written.png") });
await page.locator("#undo").click();
await until(() => !("goo.yaml" in powderdsl.edits.files));

// A universe has an address, which the menu asks for; reloading, links and Back keep it.
const universe = async () => ({ key: await page.evaluate(() => powderdsl.rules.key), files: await files(), hash: new URL(page.url()).hash.slice(0, 20) });
await page.locator("#rules").selectOption("universe…");
await page.locator("#universe input").fill("7");
await page.screenshot({ path: join(folder, "universe-seed.png") });
await page.locator("#universe button", { hasText: "Open" }).click();
await until(() => powderdsl.rules.key === "universe_7");
await said("problems", /No mistakes|remark|warning/);
seen.universe = { ...(await universe()), text: await page.evaluate(() => powderdsl.edits.files["universe_7.yaml"]), menu: await page.locator("#rules").inputValue() };
await until(() => powderdsl.engine.clock()[2] > 30n);
await page.screenshot({ path: join(folder, "universe.png") });
await page.locator("#size").selectOption("128x128");
await until(() => powderdsl.engine.rows === 128);
await page.locator("#size").selectOption("64x64");
await until(() => powderdsl.engine.rows === 64);
await page.locator("#share").click();
await until(() => location.hash.startsWith("#w="));
const link = page.url();
await page.waitForTimeout(1500);
await page.reload();
await until(() => globalThis.powderdsl?.firstWorld);
seen.back = await page.evaluate(() => powderdsl.rules.key);
const { page: linked } = await openPage(browser, link);
await linked.waitForFunction(() => powderdsl.rules.key === "universe_7", null, { timeout: 180000 });
seen.linked = await linked.locator("#status").innerText();
await linked.evaluate(() => (location.hash = "#universe=12345678901"));
await linked.evaluate(() => (location.hash = "#universe=9999999999"));
await tools(linked).said("status", /no universe/);
seen.refused = await linked.locator("#status").innerText();
await linked.close();
const { page: framed } = await openPage(browser, `${address}play.html?embed#universe=3`);
await framed.waitForFunction(() => powderdsl.rules.key === "universe_3" && powderdsl.running, null, { timeout: 180000 });
await framed.close();
seen.status = await text("status");
seen.problems = problems;
console.log(JSON.stringify(seen, null, 1));
await browser.close();
