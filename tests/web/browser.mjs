// Starts headless Chromium, opens a page of the playground, and collects what its console reports.
import { execSync } from "node:child_process";
import { chromium } from "playwright-core";

const NAMES = ["chromium-headless-shell", "chromium", "google-chrome"];

export function executable() {
  for (const name of NAMES) {
    try {
      return execSync(`command -v ${name}`, { shell: "/bin/sh" }).toString().trim();
    } catch {
      // the next one
    }
  }
  return null;
}

export async function launch() {
  return chromium.launch({ executablePath: executable(), args: ["--no-sandbox", "--disable-gpu", "--js-flags=--expose-gc"] });
}

/** `before` is run in the page before its own scripts. */
export async function openPage(browser, address, { before, tour = false, ...options } = {}) {
  const page = await browser.newPage({ viewport: { width: 1440, height: 900 }, ...options });
  if (!tour) await page.addInitScript(() => localStorage.setItem("toured", "yes"));
  if (before) await page.addInitScript(before);
  const problems = [];
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type())) problems.push(message.text());
  });
  page.on("pageerror", (error) => problems.push(String(error.stack ?? error).slice(0, 400)));
  await page.goto(address);
  await page.waitForFunction(() => globalThis.powderdsl?.firstWorld);
  return { page, problems };
}

/** What tests do with a page again and again. */
export function tools(page) {
  const text = (id) => page.locator(`#${id}`).textContent();
  const until = (test, argument) =>
    page.waitForFunction(test, argument, { timeout: 60000 }).catch(async (error) => {
      const words = await page.evaluate(() => ["status", "compiler", "problems"].map((id) => document.getElementById(id).textContent));
      throw new Error(`${error.message} ${test}: ${words.join(" | ").slice(0, 600)}`);
    });
  const said = (id, pattern) =>
    until(([name, source]) => new RegExp(source).test(document.getElementById(name).textContent), [id, pattern.source]);
  const settled = () => until(() => !powderdsl.swapping);
  const state = () =>
    page.evaluate(() => {
      const { engine, rules, named } = powderdsl;
      const menus = ["rules", "world", "size", "seed"].map((id) => document.getElementById(id).value);
      const { ids, clock } = engine.snapshot();
      const hash = ids.reduce((found, one) => Math.imul(found ^ one, 0x01000193) >>> 0, 0x811c9dc5);
      const pack = engine.elements.at(-1).qualified.split(".")[0];
      return { menus, key: rules.key, named, size: `${engine.rows}x${engine.columns}`, pack, hash, clock: clock.map(String) };
    });
  const count = (name) =>
    page.evaluate((one) => {
      const { engine } = powderdsl;
      return engine.counts()[engine.elements.find((each) => each.name === one)?.id] ?? 0;
    }, name);
  const choose = async (id, value) => {
    await page.locator(`#${id}`).selectOption(value);
    await settled();
  };
  const edit = (from, to) => replaceText(page, from, to);
  /** The compiler is there; it may take longer here than people want to wait, since other tests run. */
  const ready = async () => {
    await until(() => globalThis.powderdsl?.compilerReady && powderdsl.linkOpened && powderdsl.edits);
    await page.evaluate(() => (powderdsl.edits.compiler.limit = 60_000));
  };
  const applied = () => until(() => powderdsl.edits.applyTook !== null);
  const files = () => page.evaluate(() => Object.keys(powderdsl.edits.files));
  async function paint(x, y) {
    const box = await page.locator("#canvas").boundingBox();
    await page.mouse.click(box.x + box.width * x, box.y + box.height * y);
  }
  return { text, until, ready, said, settled, state, count, choose, edit, applied, files, paint };
}

/** Replaces a text in the shown file, or in the first one that has it. */
export const replaceText = (page, from, to) =>
  page.evaluate(
    async ([old, fresh]) => {
      const { files, shown, editor: { view } } = powderdsl.edits;
      const { goTo } = await import("./rules.js");
      const file = files[shown].includes(old) ? shown : Object.keys(files).find((name) => files[name].includes(old));
      if (file !== shown) goTo(file, 1, 1);
      const at = view.state.doc.toString().indexOf(old);
      if (at < 0) throw new Error(`${old} is not in the file`);
      view.dispatch({ changes: { from: at, to: at + old.length, insert: fresh } });
    },
    [from, to],
  );

/** The hash of a link to a world of life, shared in a page of its own. */
export async function linkToLife(browser, address, run = false) {
  const { page } = await openPage(browser, address);
  if (run) await page.locator("#run").click();
  await page.waitForFunction(() => powderdsl.linkOpened, null, { timeout: 60000 });
  await page.locator("#rules").selectOption("life");
  await page.waitForFunction(() => powderdsl.rules.key === "life");
  await page.locator("#share").click();
  await page.waitForFunction(() => location.hash.length > 10);
  const link = await page.evaluate(() => location.hash);
  await page.close();
  return link;
}
