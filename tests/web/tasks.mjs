// Plays a task: node tasks.mjs ADDRESS FOLDER
import { join } from "node:path";
import { launch, openPage, tools } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
const { page, problems } = await openPage(context, `${address}play.html`);
const { until, paint, said } = tools(page);
const seen = {};

await page.waitForFunction(() => powderdsl.linkOpened, null, { timeout: 60000 });
await page.locator("#tab-tasks").click();
await page.locator("#tasks .wide").first().waitFor();
seen.list = await page.locator("#tasks .wide strong").allInnerTexts();
await page.locator("#tasks .wide", { hasText: "ice-bridge" }).click();
await until(() => powderdsl.play);
const words = (one = page) => one.locator("#tasks").innerText();
const left = (one, count) => one.waitForFunction((wanted) => document.getElementById("tasks").innerText.includes(`\n${wanted} of 24 actions left`), count, { timeout: 60000 });
seen.begun = await words();
await page.screenshot({ path: join(folder, "task.png") });
const placed = async (x, y, count) => {
  await paint(x, y);
  await left(page, count);
};
await placed(0.25, 0.6, 23);
await placed(0.3, 0.6, 22);
// What is painted between two actions does not count: the world of the task goes on.
await page.evaluate(() => powderdsl.engine.begin(powderdsl.engine.ids().map(() => 6), 0));
await page.locator("#tasks button", { hasText: "Do nothing" }).click();
await left(page, 21);
const whole = (one) => one.evaluate(() => {
  const { ids, clock } = powderdsl.engine.snapshot();
  return [ids.join(), clock.map(String), document.querySelector("#tasks td").textContent];
});
const here = await whole(page);
seen.you = here[2];
seen.hash = new URL(page.url()).hash;
await page.locator("#tasks button", { hasText: "Share" }).click();
await said("status", /replays your actions/);
await page.waitForTimeout(1500);
await page.reload();
await page.waitForFunction(() => globalThis.powderdsl?.linkOpened, null, { timeout: 60000 });
await left(page, 21);
seen.reloaded = JSON.stringify(await whole(page)) === JSON.stringify(here);
const { page: other, problems: others } = await openPage(browser, page.url());
await left(other, 21);
seen.replayed = JSON.stringify(await whole(other)) === JSON.stringify(here);
seen.said = await other.locator("#status").innerText();
// The last action has been taken: no other follows.
const rest = "0014".repeat(24);
await other.evaluate((actions) => (location.hash = `#task=ice-bridge&world=1&actions=${actions}`), rest);
await left(other, 0);
seen.over = await words(other);
await other.locator("#tasks button", { hasText: "All tasks" }).click();
seen.ended = await other.evaluate(() => powderdsl.play);
for (const bad of ["#task=x", "#task=ice-bridge&world=99", "#task=ice-bridge&world=0&actions=zzzz", `#task=ice-bridge&actions=${rest}00`]) {
  await other.evaluate((hash) => (location.hash = hash), bad);
  await tools(other).said("status", /no task|worlds 0 to|no such actions/);
  await other.evaluate(() => (document.getElementById("status").textContent = ""));
}
seen.problems = [...problems, ...others];
console.log(JSON.stringify(seen, null, 1));
await browser.close();
