// Runs modules that stand alone, and hashes what they hold. In Node.js: node alone.mjs JOBS.json, a list of
// {module, cells, fields, clock, params, steps} with bytes in base64. In a page: `runJobs(jobs)`.

export function fnv(bytes) {
  let hash = 0x811c9dc5;
  for (const byte of bytes) hash = Math.imul(hash ^ byte, 0x01000193);
  return hash >>> 0;
}

const bytesOf = (text) => Uint8Array.from(atob(text), (char) => char.charCodeAt(0));
const SIZES = { uint8: 1, int8: 1, int16: 2, int32: 4, float32: 4 };

export function runJob({ module, cells, fields, clock, params, steps }) {
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
  const began = performance.now();
  world.step(steps);
  const hashes = { element: fnv(bytes(world.show(), count)) };
  const microseconds = ((performance.now() - began) * 1000) / steps;
  about.fields.forEach((field, number) => {
    const size = count * field.components * SIZES[field.type];
    hashes[field.name] = fnv(bytes(world.field(number), size));
  });
  return { hashes, microseconds };
}

export const runJobs = (jobs) => jobs.map(runJob);

if (typeof process !== "undefined") {
  const { readFileSync } = await import("node:fs");
  console.log(JSON.stringify(runJobs(JSON.parse(readFileSync(process.argv[2], "utf8")))));
}
