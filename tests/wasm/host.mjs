// Runs a module on the files of a folder and prints a hash of each slot. Usage: node host.mjs FOLDER
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

const folder = process.argv[2];
const read = (name) => readFileSync(`${folder}/${name}`);
const job = JSON.parse(read("job.json"));
const { instance } = await WebAssembly.instantiate(read("module.wasm"));
const { allocate, load, memory, run, scratch, store } = instance.exports;
const HEADER = 16; // what comes before the inputs of a batch
const write = (data, at) => new Uint8Array(memory.buffer).set(data, at);

const batch = allocate(job.worlds, job.rows);
for (const { slot, numbers } of job.calls) {
  const data = read(slot);
  const at = scratch(data.length);
  write(data, at);
  const [number, planes, signed, size, begin, apart] = numbers;
  load(batch, number, planes, signed, size, at + begin, apart);
}
write(read("inputs"), batch + HEADER);
run(batch, job.steps);
const hashes = {};
for (const name of new Set(job.calls.map((call) => call.slot))) {
  const bytes = read(name).length;
  const at = scratch(bytes);
  for (const { slot, numbers } of job.calls) {
    if (slot !== name) continue;
    const [number, planes, signed, size, begin, apart] = numbers;
    store(batch, number, planes, signed, size, at + begin, apart);
  }
  hashes[name] = createHash("sha256").update(new Uint8Array(memory.buffer, at, bytes)).digest("hex");
}
console.log(JSON.stringify(hashes));
