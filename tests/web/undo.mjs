// Everything can be undone, and swaps of the engine do not race: node undo.mjs ADDRESS
import { launch, openPage, tools } from "./browser.mjs";

const [address] = process.argv.slice(2);
const browser = await launch();
const { page, problems } = await openPage(browser, address);
const seen = {};

const { text, until, ready, said, settled, state, count, choose, edit, applied, files, paint } = tools(page);

// While the compiler loads: sizes, seeds and worlds can be undone, and a painted world keeps its cells.
await page.locator("#run").click();
await choose("world", "empty");
await page.locator("#elements button", { hasText: "sand" }).click();
await page.keyboard.press(" ");
seen.spaceRuns = await page.evaluate(() => powderdsl.running);
await page.keyboard.press(" ");
seen.spacePauses = !(await page.evaluate(() => powderdsl.running));
await paint(0.5, 0.5);
const painted = await state();
seen.sand = [await count("sand")];
for (const size of ["128x128", "64x64"]) {
  await choose("size", size);
  seen.sand.push(await count("sand"));
}
seen.framed = await page.evaluate(() => {
  const { engine, rules } = powderdsl;
  return [engine.ids()[0], engine.ids().at(-1), engine.counts()[rules.frame]].join() === [rules.frame, rules.frame, 252].join();
});
await choose("size", "128x128");
await choose("world", "random");
await page.locator("#seed").fill("7");
await page.locator("#seed").press("Enter");
const random = await state();
await choose("rules", "life");
await page.locator("#run").click();
await page.locator("#reset").click();
const life = await state();
const journey = [];
for (let i = 0; i < 7; i++) {
  await page.locator("#undo").click();
  await settled();
  journey.push(await state());
}
seen.undone = [journey[1].hash === random.hash && journey[1].key === "powderworld", journey.at(-1).hash === painted.hash];
seen.undoneMenus = journey.map((one) => one.menus.join(" "));
for (let i = 0; i < 7; i++) {
  await page.locator("#redo").click();
  await settled();
}
const redone = await state();
seen.redone = redone.key === "life" && redone.hash === life.hash;

// Seeds as on the command line, shown as they are used.
seen.seeds = [];
for (const seed of ["-1", "99999999999", "9223372036854775807", "9223372036854775808", "1.5", "1e3"]) {
  await page.locator("#seed").fill(seed);
  await page.locator("#seed").press("Enter");
  const { menus, clock } = await state();
  seen.seeds.push(`${menus[3]} ${clock[0]}`);
}

// A value that a field's numbers cannot hold is cut, not wrapped.
await choose("rules", "powderworld");
await page.locator("#run").click();
await page.locator("[data-tool=field]").click();
const fields = await page.evaluate(() => powderdsl.engine.fields.map((one) => `${one.name} ${one.type}`));
await page.locator("#field").selectOption(String(fields.findIndex((one) => / int8/.test(one))));
await page.locator("#value").fill("200");
await paint(0.5, 0.5);
const middle = () => page.evaluate(() => {
  const { engine } = powderdsl;
  return Math.max(...engine.field(Number(document.getElementById("field").value)));
});
seen.field = await middle();
await page.locator("[data-tool=brush]").click();

// What fails to load leaves the menus as they were.
await page.route("**/rules/wireworld*", (route) => route.fulfill({ status: 500, body: "no" }));
await choose("rules", "wireworld");
seen.failed = (await state()).menus[0];
await page.unroute("**/rules/wireworld*");

// Rules that are chosen while edited ones are compiled: those that were chosen run.
await ready();
await said("problems", /No mistakes/);
await page.evaluate(() => {
  const { compiler } = powderdsl.edits;
  const { call } = compiler;
  compiler.call = async (...words) => {
    const found = await call.apply(compiler, words);
    if (words[0] === "compile") powderdsl.compiles = (powderdsl.compiles ?? 0) + 1;
    if (words[0] === "compile") await new Promise((resolve) => setTimeout(resolve, 400));
    return found;
  };
});
await edit("density: 4", "density: 3");
await until(() => powderdsl.compiles);
await choose("rules", "life");
await page.waitForTimeout(600);
const raced = await state();
seen.raced = [raced.menus[0], raced.key, raced.pack, Object.keys(await page.evaluate(() => powderdsl.edits.files))[0] && (await files())[0]];
await page.locator("#undo").click();
await settled();
seen.edited = [await text("rules"), await page.evaluate(() => powderdsl.edits.files["sand.yaml"].includes("density: 3"))];

// A pack that is switched off comes back, with the fields of its rules; so does the value of a parameter.
const packs = () => page.evaluate(() => [[...powderdsl.edits.off], powderdsl.engine.fields.some((one) => one.name === "velocity")]);
await page.locator("#packs .pack", { hasText: "wind" }).locator("input").uncheck();
await applied();
seen.off = [await packs()];
for (const way of ["undo", "redo", "undo"]) {
  await page.locator(`#${way}`).click();
  await settled();
  await applied();
  seen.off.push(await packs());
}
await page.locator("#tab-parameters").click();
const slider = page.locator("#parameters input").first();
const value = async () => [await page.evaluate(() => powderdsl.engine.values[0]), Number(await slider.inputValue())];
seen.parameter = [await value()];
await slider.fill("0.25");
seen.parameter.push(await value());
for (const way of ["undo", "redo"]) {
  await page.locator(`#${way}`).click();
  await settled();
  seen.parameter.push(await value());
}
seen.problems = problems;
console.log(JSON.stringify(seen, null, 1));
await browser.close();
