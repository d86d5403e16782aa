// The built documentation: node docs.mjs ADDRESS FOLDER QUESTIONS.json
// Pictures go to FOLDER. Prints, as JSON, what axe finds, pages that are wider than the screen, and the first three
// pages that the search finds for each question.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { launch } from "./browser.mjs";

const [address, folder, questions] = process.argv.slice(2);
const AXE = readFileSync(fileURLToPath(import.meta.resolve("axe-core/axe.min.js")), "utf8");
const PAGES = ["index", "guides/recipes", "language/rules", "elements/powderworld/water", "tasks/index", "api", "commands", "results"];
const browser = await launch();
const report = { violations: [], wide: [], problems: [], answers: {} };

for (const colorScheme of ["light", "dark"])
  for (const width of [1440, 768, 390]) {
    const context = await browser.newContext({ bypassCSP: true, colorScheme, viewport: { width, height: 900 } });
    const page = await context.newPage();
    page.on("pageerror", (error) => report.problems.push(String(error)));
    for (const name of PAGES) {
      const where = `${name} ${width} ${colorScheme}`;
      await page.goto(`${address}${name}.html`);
      await page.evaluate(AXE);
      const violations = await page.evaluate(async () => (await axe.run(document, { resultTypes: ["violations"] })).violations);
      for (const { id, nodes } of violations)
        report.violations.push(`${where}: ${id}: ${nodes.slice(0, 3).map((node) => node.target.join(" ")).join(", ")}`);
      if (await page.evaluate(() => document.documentElement.scrollWidth > innerWidth)) report.wide.push(where);
      await page.screenshot({ path: join(folder, `${name.replaceAll("/", "-")}-${width}-${colorScheme}.png`) });
    }
    await context.close();
  }

const page = await browser.newPage({ viewport: { width: 1440, height: 900 } });
await page.goto(`${address}index.html`);
const query = page.locator(".md-search__input").first();
await query.click();
for (const { ask } of JSON.parse(questions)) {
  await query.fill("");
  const state = (empty) =>
    page.waitForFunction((empty) => document.querySelector(".md-search-result__meta").textContent.includes("Type to start") === empty, empty, { timeout: 60_000 });
  await state(true);
  await query.pressSequentially(ask);
  await state(false);
  await page.waitForTimeout(500); // the last words of the question
  report.answers[ask] = await page
    .locator(".md-search-result__item")
    .evaluateAll((pages) => pages.slice(0, 3).map((page) => page.querySelector("a").href));
}
await browser.close();
console.log(JSON.stringify(report));
