// Frames a second and the time from input to picture, while a pack is being checked: node frames.mjs ADDRESS
import { launch, openPage } from "./browser.mjs";

const SECONDS = 5;
const CLICKS = 40;
const [address] = process.argv.slice(2);
const browser = await launch();
const { page } = await openPage(browser, address);
await page.waitForFunction(() => powderdsl.compilerReady && powderdsl.linkOpened, null, { timeout: 60000 });

/** Edits the shown pack anew as soon as it has been checked, so that the compiler always works. */
const busy = (on) =>
  page.evaluate((wanted) => {
    globalThis.busy = wanted;
    globalThis.checks = 0;
    if (!wanted) return;
    const { editor } = powderdsl.edits;
    const line = editor.view.state.doc.length;
    editor.view.dispatch({ changes: { from: line, insert: "\nbroken: yes" } });
    const again = () => {
      if (!globalThis.busy) return;
      if (powderdsl.edits.checkTook === null) return void setTimeout(again, 5);
      globalThis.checks++;
      editor.view.dispatch({ changes: { from: editor.view.state.doc.length, insert: " " } });
      setTimeout(again, 5);
    };
    again();
  }, on);

async function frames() {
  const [before, began] = await page.evaluate(() => [powderdsl.frames, performance.now()]);
  await page.waitForTimeout(SECONDS * 1000);
  const [after, ended] = await page.evaluate(() => [powderdsl.frames, performance.now()]);
  return Math.round(((after - before) * 10000) / (ended - began)) / 10;
}

/** The median of ms from a pointer's press to the frame that shows it. */
async function latency() {
  const box = await page.locator("#canvas").boundingBox();
  await page.evaluate(() => {
    globalThis.latencies = [];
    document.getElementById("canvas").addEventListener("pointerdown", ({ timeStamp }) => {
      const drawn = powderdsl.drawn;
      powderdsl.drawn = (image) => {
        drawn(image);
        powderdsl.drawn = drawn;
        const channel = new MessageChannel(); // after this frame has been painted
        channel.port1.onmessage = () => latencies.push(performance.now() - timeStamp);
        channel.port2.postMessage(0);
      };
    });
  });
  for (let i = 0; i < CLICKS; i++) {
    await page.mouse.click(box.x + box.width * (0.2 + (0.6 * i) / CLICKS), box.y + box.height * 0.3);
    await page.waitForTimeout(37);
  }
  const found = (await page.evaluate(() => latencies)).sort((a, b) => a - b);
  return Math.round(found[found.length >> 1] * 10) / 10;
}

const seen = {};
for (const size of ["64x64", "256x256", "512x512"]) {
  await page.locator("#size").selectOption(size);
  await page.waitForFunction((name) => `${powderdsl.engine.rows}x${powderdsl.engine.columns}` === name, size);
  if (!(await page.evaluate(() => powderdsl.running))) await page.locator("#run").click();
  await page.waitForTimeout(1000);
  const quiet = await frames();
  await busy(true);
  const checking = await frames();
  const checks = await page.evaluate(() => globalThis.checks);
  const input = await latency();
  await busy(false);
  seen[size] = { quiet, checking, checks, input };
}
console.log(JSON.stringify(seen));
await browser.close();
