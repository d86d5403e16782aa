// Steps a module and draws it as the page does: node drawn.mjs FOLDER STEPS, with engine.js, view.js and world.wasm
// in the folder. Prints the ids, the fields and the picture's bytes as JSON.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [folder, steps] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(join(folder, name)));

globalThis.ImageData = class {
  constructor(width, height) {
    this.data = new Uint8ClampedArray(4 * width * height);
  }
};
const { Engine } = await load("engine.js");
const { Painter } = await load("view.js");
const engine = await Engine.start(new WebAssembly.Module(readFileSync(join(folder, "world.wasm"))));
const known = engine.elements.map((one) => one.id);
engine.begin(Uint8Array.from({ length: engine.cells }, (_, i) => known[(i * i) % known.length]), 1n);
engine.step(Number(steps));
const picture = [...new Painter(engine).draw().data];
const fields = Object.fromEntries(engine.fields.map((one, number) => [one.name, [...engine.field(number)]]));
console.log(JSON.stringify({ ids: [...engine.ids()], fields, picture }));
