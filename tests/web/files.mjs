// Files are renamed, duplicated, deleted and dropped; links and files hold works; tests are drawn: node files.mjs ADDRESS FOLDER
import { join } from "node:path";
import { launch, openPage, tools } from "./browser.mjs";

const [address, folder] = process.argv.slice(2);
const browser = await launch();
const { page, problems } = await openPage(browser, address);
const { text, until, ready, said, settled, state, choose, edit, applied, files } = tools(page);
const seen = {};

const tabs = (page) => page.locator("#packs .pack").allInnerTexts();
const drop = (given) =>
  page.locator("#file").setInputFiles(given.map(([name, content]) => ({ name, mimeType: "", buffer: Buffer.from(content) })));
const undo = async () => {
  await page.locator("#undo").click();
  await settled();
};
const own = (name, more = "") => `pack: ${name}\nabout: One.\nelements:\n  ${name}: {color: "#ff0000"}\n${more}`;
const element = (name) => until((one) => powderdsl.engine.elements.some((each) => each.name === one), name);

await page.locator("#run").click();
await ready();
await said("problems", /No mistakes/);

// Two dropped files both open, one of a name that is there replaces it, and all of it can be undone.
await drop([["red.yaml", own("red")], ["blue.yaml", own("blue")]]);
await element("red");
await element("blue");
// The new rules may run before the message is read, so all messages are kept.
await page.evaluate(() => {
  const status = document.getElementById("status");
  window.messages = [];
  new MutationObserver(() => window.messages.push(status.textContent)).observe(status, { childList: true });
});
await drop([["red.yaml", own("red", "# other\n")]]);
await page.waitForFunction(() => window.messages.some((one) => one.includes("replaced")));
seen.replaced = [await page.evaluate(() => window.messages.find((one) => one.includes("replaced"))), await page.evaluate(() => powderdsl.edits.files["red.yaml"].includes("other"))];
await undo();
seen.replaced.push(await page.evaluate(() => powderdsl.edits.files["red.yaml"].includes("other")));

// Ten packs of one's own.
for (let i = 0; i < 10; i++) await page.locator("#packs button", { hasText: "+ pack" }).click();
seen.mine = (await files()).filter((one) => one.startsWith("mine"));
for (let i = 0; i < 9; i++) await undo();

// Rename, with the keyboard; duplicate; delete.
await page.locator("#packs button", { hasText: "mine" }).focus();
await page.keyboard.press("F2");
await page.keyboard.type("dust");
await page.keyboard.press("Enter");
await page.locator("#packs button", { hasText: "Duplicate" }).click();

seen.renamed = [(await files()).slice(-2), await page.evaluate(() => powderdsl.edits.files["dust2.yaml"].split("\n")[0])];
await page.locator("#packs button", { hasText: "Delete" }).click();
seen.deleted = [await text("status"), (await files()).at(-1)];
await undo();
seen.deleted.push((await files()).at(-1));
await page.locator("#packs button", { hasText: "Rename" }).click();
await page.keyboard.type("red");
await page.keyboard.press("Enter");
seen.taken = await text("status");
await edit("pack: dust2", "pack: ashes");
await applied();
seen.typed = [(await files()).at(-1), await page.locator("#packs .pack.shown").innerText()];
await page.screenshot({ path: join(folder, "files.png") });

// A test that fails shows what was given, expected and got.
await page.locator("#packs button", { hasText: "sand" }).click();
await edit("# s s #", "# s . #");
await applied();
await page.locator("[data-panel=checks]").click();
await page.locator("#checks button", { hasText: "Run the tests" }).click();
await page.locator("#checks figure").first().waitFor({ timeout: 60000 });
seen.figures = await page.evaluate(() =>
  [...document.querySelectorAll("#checks figure")].map((one) => {
    const canvas = one.querySelector("canvas");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return [one.innerText, canvas.width, canvas.height, new Set(new Uint32Array(data.buffer)).size];
  }),
);
await page.screenshot({ path: join(folder, "tests.png") });
await page.locator("[data-panel=rules-panel]").click();

// A ruleset opens alone, with its packs that ship, and says which ones are missing.
await drop([["lab.yaml", "ruleset: lab\nabout: Mine.\npacks: [core, sand, water, zzz]\n"]]);
await said("problems", /Packs are missing: zzz/);
seen.lab = await files();
await page.screenshot({ path: join(folder, "missing.png") });
await page.locator("#problems button", { hasText: "Add zzz" }).click();
await element("zzz");
seen.added = await files();
await undo();
await undo();
seen.left = (await files()).includes("powderworld.yaml");

// Links: a busy world of the usual size fits; a large one is offered as a file, which opens it again.
await choose("rules", "powderworld");
await page.locator("#run").click();
await page.evaluate(() => powderdsl.engine.step(300));
seen.links = [];
const share = async () => {
  await page.evaluate(() => (document.getElementById("status").textContent = ""));
  await page.locator("#share").click();
  await said("status", /characters/);
  seen.links.push(await text("status"));
};
await share();
const reader = await openPage(browser, page.url());
await reader.page.waitForFunction(() => powderdsl.linkOpened, null, { timeout: 60000 });
seen.sameLink = (await tools(reader.page).state()).hash === (await state()).hash;
await reader.page.close();
const blow = () =>
  page.evaluate(() => {
    const { engine } = powderdsl;
    const view = engine.field(engine.motion);
    for (let i = 0; i < view.length; i++) view[i] = Math.random();
    engine.calls.take(engine.motion);
  });
const wind = () => page.evaluate(() => powderdsl.engine.field(powderdsl.engine.motion).reduce((sum, one) => sum + one, 0));
await blow();
await share();
await choose("size", "256x256");
await blow();
await share();
const [large, blown] = [await state(), await wind()];
const waiting = page.waitForEvent("download");
await page.locator("#status button").click();
await (await waiting).saveAs(join(folder, "world.powder"));
await choose("rules", "life");
await page.locator("#file").setInputFiles(join(folder, "world.powder"));
await said("status", /world of world.powder/);
seen.sameFile = (await state()).hash === large.hash && (await wind()) === blown;
seen.hash = await page.evaluate(() => location.hash.length);
// A message about a file names no folder of the compiler's.
await drop([["my.npz", "nothing"]]);
await said("status", /npz/);
seen.message = await text("status");
seen.problems = problems;
console.log(JSON.stringify(seen, null, 1));
await browser.close();
