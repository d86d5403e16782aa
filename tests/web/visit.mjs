// How fast visits of an exported site are: node visit.mjs FOLDER [MEGABITS LATENCY]
// Serves FOLDER as a static host would, visits it three times (the last one offline), and prints the numbers as JSON.
import { createHash } from "node:crypto";
import { existsSync, readFileSync, statSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { launch } from "./browser.mjs";

const [folder, megabits, latency = "40"] = process.argv.slice(2);
const TYPES = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".css": "text/css", ".wasm": "application/wasm" };
const asked = [];
const sockets = new Set();
const changed = new Map(); // files of another version
const hash = (data) => createHash("sha256").update(data).digest("hex").slice(0, 16);
const file = (path) => {
  const data = readFileSync(join(folder, path));
  return changed.has(path) ? Buffer.from(changed.get(path)(data.toString())) : data;
};
const server = createServer((request, response) => {
  const path = decodeURIComponent(new URL(request.url, "http://x").pathname);
  const name = normalize(path.endsWith("/") ? `${path}index.html` : path);
  asked.push(path);
  if (!existsSync(join(folder, name)) || !statSync(join(folder, name)).isFile()) return response.writeHead(404).end();
  const packed = !changed.has(name) && existsSync(join(folder, `${name}.gz`)) && /gzip/.test(request.headers["accept-encoding"] ?? "");
  const data = file(packed ? `${name}.gz` : name);
  const tag = `"${hash(data)}"`;
  const headers = { ETag: tag, "Cache-Control": "no-cache", "Content-Type": TYPES[extname(name)] ?? "application/octet-stream" };
  if (request.headers["if-none-match"] === tag) return response.writeHead(304, headers).end();
  response.writeHead(200, { ...headers, "Content-Length": data.length, ...(packed && { "Content-Encoding": "gzip" }) });
  response.end(data);
});
server.on("connection", (socket) => sockets.add(socket));
const sent = () => [...sockets].reduce((sum, one) => sum + one.bytesWritten, 0);
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
const address = `http://127.0.0.1:${server.address().port}/`;

const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
const problems = [];

/** Waits until a worker of the registration, such as `active` or `waiting`, has a state. */
async function worker(page, name, state) {
  const found = () => page.evaluate(async (one) => (await navigator.serviceWorker.getRegistration())?.[one]?.state, name);
  for (let i = 0; i < 600 && (await found()) !== state; i++) await page.waitForTimeout(100);
}

/** Opens the page, and waits until the compiler is ready and, on the first visit, the service worker has all files. */
async function visit(name, { throttled = false, page: path = "play.html" } = {}) {
  const [bytes, requests] = [sent(), asked.length];
  const page = await context.newPage();
  page.on("pageerror", (error) => problems.push(`${name}: ${error}`));
  page.on("console", (one) => one.type() === "error" && problems.push(`${name}: ${one.text()}`));
  if (throttled) {
    const session = await context.newCDPSession(page);
    const throughput = (Number(megabits) * 1e6) / 8;
    await session.send("Network.enable");
    await session.send("Network.emulateNetworkConditions", {
      offline: false,
      latency: Number(latency),
      downloadThroughput: throughput,
      uploadThroughput: throughput,
    });
  }
  await page.goto(address + path, { timeout: 120_000 });
  await page.waitForFunction(() => globalThis.powderdsl?.compilerReady, null, { timeout: 120_000 });
  const [picture, ready] = await page.evaluate(() => [powderdsl.firstPicture, powderdsl.compilerReady]);
  const isKept = await page.workers()[0].evaluate(() => Boolean(python._api.config._loadSnapshot));
  const untilReady = sent() - bytes;
  await worker(page, "active", "activated");
  await page.waitForTimeout(500);
  const found = { picture: Math.round(picture), ready: Math.round(ready), isKept, untilReady, bytes: sent() - bytes, paths: asked.slice(requests) };
  await page.close();
  return found;
}

const seen = { first: await visit("first", { throttled: Boolean(megabits) }) };
seen.second = await visit("second", { throttled: Boolean(megabits) });

// Another version: the page that is open keeps the old one, the next visit of a page alone has the new one.
if (!megabits) {
  changed.set("/play.html", (data) => data.replace("<title>powderdsl", "<title>new powderdsl"));
  changed.set("/sw.js", (data) => data.replace(/"play.html":"\w+"/, `"play.html":"${hash(file("/play.html"))}"`).replace(/powderdsl-\$\{"/, '$&new-'));
  const page = await context.newPage();
  const title = async () => ((await page.title()).startsWith("new") ? "new" : "old");
  await page.goto(`${address}play.html`);
  const texts = [await title()];
  await worker(page, "waiting", "installed");
  await page.reload();
  await page.waitForFunction(() => document.title.startsWith("new"), null, { timeout: 30_000 }).catch(() => {});
  texts.push(await title());
  seen.replaced = { texts, caches: await page.evaluate(async () => (await caches.keys()).filter((one) => one.startsWith("powderdsl-")).length) };
  await page.close();
}
server.close();
for (const socket of sockets) socket.destroy();
seen.offline = await visit("offline");
seen.first.paths = seen.first.paths.length;
console.log(JSON.stringify({ ...seen, problems }, null, 1));
await browser.close();
