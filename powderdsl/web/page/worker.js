// The compiler: Pyodide in a worker. Requests are {id, name, args}, answers {id, result} or {id, error}.

import { loadPyodide } from "./parts/pyodide/pyodide.mjs";

const here = new URL(".", import.meta.url);
const place = new URL("memory", here);
const stage = (text) => postMessage({ stage: text });

async function boot() {
  stage("loading Python");
  const fetched = fetch(new URL("python.zip", here)).then((answer) => answer.arrayBuffer());
  const start = (options) => loadPyodide({ indexURL: new URL("parts/pyodide/", here).href, ...options });
  // The browser keeps the memory of a started compiler: that of the same archive starts in a third of the time.
  const cache = await globalThis.caches?.open("powderdsl").catch(() => {});
  const kept = await cache?.match(place);
  const nameOf = async ({ length }) => `${length} ${new Uint8Array(await crypto.subtle.digest("SHA-256", await fetched))}`;
  const bytes = kept && new Uint8Array(await kept.arrayBuffer());
  const isSame = bytes && kept.headers.get("of") === (await nameOf(bytes));
  let python = isSame && (await start({ _loadSnapshot: bytes }).catch(() => null));
  const isFresh = !python;
  python ||= await start({ _makeSnapshot: true });
  globalThis.python = python; // for measurements of its memory
  stage("unpacking");
  const site = python.runPython("import site; site.getsitepackages()[0]");
  python.unpackArchive(new Uint8Array(await fetched), "zip", { extractDir: site });
  stage("starting");
  python.runPython("import sys; sys.dont_write_bytecode = True; import powderdsl.web.bridge");
  const memory = isFresh && cache && python.makeMemorySnapshot();
  if (memory) nameOf(memory).then((of) => cache.put(place, new Response(memory, { headers: { of } }))).catch(() => {});
  return python.pyimport("powderdsl.web.bridge");
}

const bridge = boot();
bridge.then(
  () => stage("ready"),
  (error) => {
    globalThis.caches?.delete("powderdsl").catch(() => {}); // the next worker starts afresh
    postMessage({ stage: "failed", error: String(error.message ?? error) });
  },
);

onmessage = async ({ data: { id, name, args } }) => {
  try {
    const found = (await bridge).call(name, JSON.stringify(args));
    if (typeof found === "string") postMessage({ id, ...JSON.parse(found) });
    else {
      const result = found.toJs();
      found.destroy();
      postMessage({ id, result }, [result.buffer]);
    }
  } catch (error) {
    postMessage({ id, error: `the compiler failed: ${String(error.message ?? error).trim().split("\n").at(-1)}`, fatal: true });
  }
};
