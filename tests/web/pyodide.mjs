// Runs a Python script in Pyodide: node pyodide.mjs FOLDER SCRIPT ARCHIVE...
// Wheels and other zip archives are unpacked where Python imports from; the script runs in FOLDER.
import { readFileSync } from "node:fs";
import { loadPyodide } from "pyodide";

const [folder, script, ...archives] = process.argv.slice(2);
const python = await loadPyodide();
const site = python.runPython("import site; site.getsitepackages()[0]");
for (const archive of archives) python.unpackArchive(new Uint8Array(readFileSync(archive)), "zip", { extractDir: site });
python.mountNodeFS("/job", folder);
python.FS.chdir("/job");
// The processor time of this thread in seconds, on Linux: other programs hardly change it.
globalThis.cpu = () => Number(readFileSync("/proc/thread-self/schedstat", "utf8").split(" ")[0]) / 1e9;
try {
  python.runPython(readFileSync(script, "utf8"));
} catch (error) {
  // Not the error itself: Node.js would print the source line, which is a megabyte of minified code.
  console.error(error.message);
  process.exitCode = 1;
}
