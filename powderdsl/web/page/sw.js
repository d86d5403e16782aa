// The service worker of exported sites: keeps their files, so that later visits need no network.

const NAME = `powderdsl-${"VERSION"}`;
/** Files and the beginnings of their hashes (SHA-256), which site.py writes here. */
const FILES = "FILES";

async function keep([path, wanted]) {
  const answer = await fetch(path, { cache: "no-cache" });
  const found = new Uint8Array(await crypto.subtle.digest("SHA-256", await answer.clone().arrayBuffer()));
  const hash = Array.from(found.subarray(0, 8), (one) => one.toString(16).padStart(2, "0")).join("");
  if (!answer.ok || hash !== wanted) throw new Error(`${path} is of another version`);
  await (await caches.open(NAME)).put(path, answer);
}

async function answer(request) {
  const [path] = request.url.split(/[?#]/);
  const cache = await caches.open(NAME);
  const kept = await cache.match(path.endsWith("/") ? `${path}index.html` : path);
  if (kept) return kept;
  const found = await fetch(request);
  if (found.ok && path.includes("/rules/")) await cache.put(path, found.clone());
  return found;
}

addEventListener("install", (event) => event.waitUntil(Promise.all(Object.entries(FILES).map(keep))));
addEventListener("activate", (event) =>
  event.waitUntil(
    caches.keys().then((all) => {
      const old = all.filter((one) => one.startsWith("powderdsl-") && one !== NAME);
      return Promise.all(old.map((one) => caches.delete(one)));
    }),
  ),
);
/** A new version takes over where one page alone is open: that loads itself again. The page before it may take a moment to go. */
async function replace() {
  for (let i = 0; i < 10; i++) {
    if ((await clients.matchAll({ includeUncontrolled: true })).length < 2) return skipWaiting();
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
}
addEventListener("message", (event) => event.data === "replace" && event.waitUntil(replace()));
addEventListener("fetch", (event) => {
  const { method, url } = event.request;
  if (method === "GET" && url.startsWith(registration.scope)) event.respondWith(answer(event.request));
});
