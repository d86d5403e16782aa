// Completion, hover texts and layout in the page's editor: node words.mjs ADDRESS
import { launch, openPage, replaceText as edit, tools } from "./browser.mjs";

const [address] = process.argv.slice(2);
const browser = await launch();
const { page, problems } = await openPage(browser, address);
const { ready, said, until } = tools(page);
const seen = {};

await page.locator("#packs button", { hasText: "sand" }).click();
await ready();
await said("problems", /No mistakes/);
const text = () => page.evaluate(() => powderdsl.edits.editor.view.state.doc.toString());
const original = await text();
/** The cursor behind a text, and the place of it on the screen. */
const goTo = (words) =>
  page.evaluate((one) => {
    const { view } = powderdsl.edits.editor;
    const at = view.state.doc.toString().indexOf(one) + one.length;
    view.dispatch({ selection: { anchor: at }, scrollIntoView: true });
    view.focus();
    return at;
  }, words);

// Keys of an element where one is written, and names behind them.
seen.offered = {};
for (const [behind, typed] of [["glyph: s", ", col"], ["needs: ", "wa"], ["gravity: ", "y"]]) {
  await goTo(behind);
  await page.keyboard.type(typed);
  const items = page.locator("#editor .cm-tooltip-autocomplete li");
  await items.first().waitFor({ timeout: 60000 });
  seen.offered[behind] = await items.allInnerTexts();
  await page.keyboard.press("Escape");
  await page.evaluate((before) => {
    const { view } = powderdsl.edits.editor;
    view.dispatch({ changes: { from: 0, to: view.state.doc.length, insert: before } });
  }, original);
}
await said("problems", /No mistakes/);

// What a word means.
await goTo("elements:\n  sa");
const spot = await page.evaluate(() => {
  const { view } = powderdsl.edits.editor;
  return view.coordsAtPos(view.state.selection.main.head);
});
await page.mouse.move(spot.left, spot.top - 60);
await page.mouse.move(spot.left, (spot.top + spot.bottom) / 2, { steps: 3 });
const about = page.locator("#editor .about");
await about.waitFor({ timeout: 60000 });
seen.about = [await about.innerText(), await about.locator("b").first().innerText()];

// One layout, with the cursor behind the same word.
await edit(page, "\n  sand:", "\n\n\n      sand:");
await goTo("glyph");
await page.keyboard.press("Shift+Alt+F");
await until((before) => powderdsl.edits.editor.view.state.doc.toString().replace(/\n\n/, "\n") === before, original);
seen.behind = await page.evaluate(() => {
  const { doc, selection } = powderdsl.edits.editor.view.state;
  return doc.sliceString(selection.main.head - 5, selection.main.head);
});
await page.keyboard.press("Control+z");
seen.undone = (await text()).includes("\n\n\n      sand:");

console.log(JSON.stringify({ ...seen, problems }));
await browser.close();
