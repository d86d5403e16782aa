// Runs modules that stand alone in Node.js, and hashes what they hold: node alone.mjs JOBS.json, a list of
// {module, cells, fields, clock, params, steps} with bytes in base64.

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

const bytesOf = (text) => Buffer.from(text, "base64");
const hashOf = (bytes) => createHash("sha256").update(bytes).digest("hex");
const SIZES = { uint8: 1, int8: 1, int16: 2, int32: 4, float32: 4 };

function hashesOf({ module, cells, fields, clock, params, steps }) {
  const compiled = new WebAssembly.Module(bytesOf(module));
  const [section] = WebAssembly.Module.customSections(compiled, "powderdsl");
  const about = JSON.parse(new TextDecoder().decode(section));
  const world = new WebAssembly.Instance(compiled).exports;
  const count = about.rows * about.columns;
  const bytes = (at, size) => new Uint8Array(world.memory.buffer, at, size);
  bytes(world.cells(), count).set(bytesOf(cells));
  world.begin(0);
  bytes(world.clock(), 24).set(bytesOf(clock));
  params.forEach((value, number) => world.parameter(number, value));
  about.fields.forEach((field, number) => {
    if (!(field.name in fields)) return;
    const given = bytesOf(fields[field.name]);
    bytes(world.field(number), given.length).set(given);
    world.take(number);
  });
  world.step(steps);
  const hashes = { element: hashOf(bytes(world.show(), count)) };
  about.fields.forEach((field, number) => {
    const size = count * field.components * SIZES[field.type];
    hashes[field.name] = hashOf(bytes(world.field(number), size));
  });
  return hashes;
}

console.log(JSON.stringify(JSON.parse(readFileSync(process.argv[2], "utf8")).map(hashesOf)));
