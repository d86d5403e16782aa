// Runs a module on the files of a folder and prints a hash of each slot. Usage: node host.mjs FOLDER
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

const folder = process.argv[2];
const read = (name) => readFileSync(`${folder}/${name}`);
const job = JSON.parse(read("job.json"));
const { instance } = await WebAssembly.instantiate(read("module.wasm"));
const { allocate, inputs, load, load_real, memory, run, scratch, store, store_real } = instance.exports;
const write = (data, at) => new Uint8Array(memory.buffer).set(data, at);

const batch = allocate(job.worlds, job.rows);
for (const { slot, number, planes, signed, size, begin, apart } of job.calls) {
  const data = read(slot);
  const at = scratch(data.length);
  write(data, at);
  if (planes) load(batch, number, planes, size, at + begin);
  else load_real(batch, number, at + begin, apart);
}
write(read("inputs"), inputs(batch));
run(batch, job.steps);
const hashes = {};
for (const name of new Set(job.calls.map((call) => call.slot))) {
  const bytes = read(name).length;
  const at = scratch(bytes);
  for (const { slot, number, planes, signed, size, begin, apart } of job.calls) {
    if (slot !== name) continue;
    if (planes) store(batch, number, planes, signed, size, at + begin);
    else store_real(batch, number, at + begin, apart);
  }
  hashes[name] = createHash("sha256").update(new Uint8Array(memory.buffer, at, bytes)).digest("hex");
}
console.log(JSON.stringify(hashes));
