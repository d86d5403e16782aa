// The compiler: Pyodide in a worker. Requests are {id, name, args}, answers {id, result} or {id, error}.

import { loadPyodide } from "./parts/pyodide/pyodide.mjs";

const here = new URL(".", import.meta.url);
const stage = (text) => postMessage({ stage: text });

async function boot() {
  stage("loading Python");
  const [python, archive] = await Promise.all([
    loadPyodide({ indexURL: new URL("parts/pyodide/", here).href }),
    fetch(new URL("python.zip", here)).then((answer) => answer.arrayBuffer()),
  ]);
  globalThis.python = python; // for measurements of its memory
  stage("unpacking");
  const site = python.runPython("import site; site.getsitepackages()[0]");
  python.unpackArchive(new Uint8Array(archive), "zip", { extractDir: site });
  stage("starting");
  python.runPython("import sys; sys.dont_write_bytecode = True");
  return python.pyimport("powderdsl.web.bridge");
}

const bridge = boot();
bridge.then(
  () => stage("ready"),
  (error) => postMessage({ stage: "failed", error: String(error.message ?? error) }),
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
