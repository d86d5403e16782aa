// Damaged packs, links and files: each gives a message, and the page keeps working: node hostile.mjs ADDRESS [COUNT]
import { launch, openPage } from "./browser.mjs";

const [address, number = "200"] = process.argv.slice(2);
const count = Number(number);
const browser = await launch();
const { page, problems } = await openPage(browser, address);
await page.waitForFunction(() => powderdsl.compilerReady && powderdsl.linkOpened, null, { timeout: 60000 });

let state = 12345;
const below = (n) => {
  state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
  return Math.floor((state / 2 ** 32) * n);
};
const PIECES = ["\t", ": ", "- ", "[", "}", "'", '"', "&a", "*a", "!!x", "\u0000", "\ud800", "->", " if ", "9".repeat(40), "<b>", "?", "\n", "pack: x\n", "%"];

/** A text with one to four damages: a piece cut out, doubled, or put in. */
function damaged(text, pieces = PIECES) {
  let found = text;
  for (let n = 1 + below(4); n > 0; n--) {
    const at = below(found.length + 1);
    const length = 1 + below(12);
    const kind = below(3);
    const middle = kind === 0 ? "" : kind === 1 ? found.slice(at, at + 2 * length) : pieces[below(pieces.length)];
    found = found.slice(0, at) + middle + found.slice(kind === 2 ? at : at + length);
  }
  return found;
}

const alive = () =>
  page.evaluate(async () => {
    const before = powderdsl.frames;
    await new Promise((resolve) => setTimeout(resolve, 120));
    return powderdsl.frames > before;
  });
const seen = { packs: 0, refused: 0, links: 0, files: 0, silent: [], dead: [], memory: [] };

const text = await page.evaluate(() => powderdsl.edits.files["fire.yaml"]);
for (let n = 0; n < count / 2; n++) {
  const broken = damaged(text);
  const found = await page.evaluate(async (pack) => {
    const { edits } = powderdsl;
    try {
      const { ok, diagnostics } = await edits.compiler.check({ ...edits.files, "fire.yaml": pack }, []);
      return { ok, messages: diagnostics.filter((one) => one.severity === "error" && one.text).length };
    } catch (error) {
      return { ok: false, messages: String(error.message).length };
    }
  }, broken);
  seen.packs++;
  if (!found.ok) seen.refused++;
  if (!found.ok && !found.messages) seen.silent.push(broken);
  if (n % 10 === 0 && !(await alive())) seen.dead.push(broken);
  if (n % 10 === 0) seen.memory.push(await page.evaluate(() => Math.round(performance.memory.usedJSHeapSize / 2 ** 20)));
}

await page.locator("#share").click();
await page.waitForFunction(() => location.hash.length > 10);
const link = await page.evaluate(() => location.hash);
const LETTERS = ["A", "_", "-", "=", "%", "é", "AAAA", "<"];
for (let n = 0; n < count / 4; n++) {
  const broken = `#w=${damaged(link.slice(3), LETTERS)}`;
  const said = await page.evaluate(async (fragment) => {
    const status = document.getElementById("status");
    status.textContent = "";
    location.hash = fragment;
    for (let i = 0; i < 100 && !/damaged|version|link/.test(status.textContent); i++)
      await new Promise((resolve) => setTimeout(resolve, 30));
    return status.textContent;
  }, broken);
  seen.links++;
  if (!said) seen.silent.push(broken);
  if (n % 10 === 0 && !(await alive())) seen.dead.push(broken);
}

for (let n = 0; n < count / 4; n++) {
  const size = below(300);
  const buffer = Buffer.from(Array.from({ length: size }, () => below(256)));
  const head = n % 2 ? Buffer.from("PK\u0003\u0004") : Buffer.alloc(0);
  await page.evaluate(() => (document.getElementById("status").textContent = ""));
  await page.locator("#file").setInputFiles({ name: "world.npz", mimeType: "", buffer: Buffer.concat([head, buffer]) });
  await page.waitForFunction(() => document.getElementById("status").textContent, null, { timeout: 30000 });
  seen.files++;
}
if (!(await alive())) seen.dead.push("files");
seen.compiles = await page.evaluate(async () => {
  const { edits } = powderdsl;
  return (await edits.compiler.check(edits.files, [])).ok;
});
// A compilation that runs away is stopped with its worker; the world runs on, and so does the compiler without that pack.
const ELEMENTS = 60;
const rulesOf = (pass) =>
  Array.from({ length: 100 }, (_, i) => {
    const [from, to, first, second] = [i, 7 * i + 1, 3 * i, 5 * i + 2].map((n) => `e${n % ELEMENTS}`);
    return `      - ${from} -> ${to} if count(${first} in wide) > ${i % 5} and count(${second}) in (${pass % 7}, ${(pass % 5) + 3})`;
  });
const slow = [
  "pack: slow",
  "kernels:",
  `  wide: {rows: [${Array.from({ length: 5 }, (_, row) => (row === 2 ? '"1 1 0 1 1"' : '"1 1 1 1 1"')).join(", ")}]}`,
  "elements:",
  ...Array.from({ length: ELEMENTS }, (_, i) => `  e${i}: {color: "#${(1000 * i).toString(16).padStart(6, "0")}"}`),
  "passes:",
  ...Array.from({ length: 24 }, (_, pass) => [`  pass${pass}:`, "    do:", ...rulesOf(pass)]).flat(),
];
const limit = (ms) => page.evaluate((one) => (powderdsl.edits.compiler.limit = one), ms);
await limit(2000); // else the compiler itself refuses so much work on a fast machine
const began = Date.now();
await page.locator("#file").setInputFiles({ name: "slow.yaml", mimeType: "", buffer: Buffer.from(slow.join("\n")) });
const stopped = () => /stopped after 2 seconds/.test(document.getElementById("problems").textContent);
await page.waitForFunction(stopped, null, { timeout: 90000 });
const seconds = (Date.now() - began) / 1000;
await limit(60_000);
const running = await alive();
await page.locator("#packs input").last().click();
await page.waitForFunction(() => powderdsl.edits.applyTook !== null, null, { timeout: 60000 });
seen.stopped = { seconds, running, after: await page.locator("#status").textContent() };
seen.problems = problems;
console.log(JSON.stringify(seen));
await browser.close();
