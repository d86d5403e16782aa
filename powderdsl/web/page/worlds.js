// Worlds as JSON, as the site and links hold them. What comes from elsewhere is checked before it is used.

import { ARRAYS } from "./engine.js";

export const MAX_SIDE = 512;
export const MAX_CLOCK = 2n ** 63n - 1n; // of seeds and steps

export class BadWorld extends Error {}

export function bytes(text) {
  try {
    return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  } catch {
    throw new BadWorld("it is damaged: a part is not base64");
  }
}

export function text(array) {
  const data = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  let found = "";
  for (let i = 0; i < data.length; i += 32768) found += String.fromCharCode(...data.subarray(i, i + 32768));
  return btoa(found);
}

function expect(holds, problem) {
  if (!holds) throw new BadWorld(problem);
}

/** @param {any} data @returns {import("./engine.js").Snapshot} */
export function readWorld(data) {
  expect(data && typeof data === "object", "the world is not an object");
  const { rows, columns } = data;
  for (const side of [rows, columns])
    expect(Number.isInteger(side) && side >= 1 && side <= MAX_SIDE, `a world has 1 to ${MAX_SIDE} rows and columns`);
  const palette = new Map();
  for (const [id, name] of Object.entries(data.palette ?? {})) {
    expect(/^\d{1,3}$/.test(id) && Number(id) < 256 && typeof name === "string" && name.length < 200, "a bad palette");
    palette.set(Number(id), name);
  }
  const ids = bytes(String(data.ids));
  expect(ids.length === rows * columns, "the number of cells does not fit the size");
  const fields = new Map();
  const given = Object.entries(data.fields ?? {});
  expect(given.length <= 64, "a world has at most 64 fields");
  for (const [name, { type, components, values }] of given) {
    expect(Object.hasOwn(ARRAYS, type) && (components === 1 || components === 2), `the field ${name} has a bad type`);
    const raw = bytes(String(values));
    expect(raw.length === ids.length * components * ARRAYS[type].BYTES_PER_ELEMENT, `the field ${name} has a bad size`);
    fields.set(name, { components, values: new ARRAYS[type](raw.buffer) });
  }
  const clock = (data.clock ?? ["0", "0", "0"]).map(String);
  expect(clock.length === 3 && clock.every((one) => /^\d{1,19}$/.test(one) && BigInt(one) <= MAX_CLOCK), "a bad clock");
  return { rows, columns, palette, ids, fields, clock: clock.map(BigInt) };
}

/** @param {import("./engine.js").Snapshot} world */
export function writeWorld({ rows, columns, palette, ids, fields, clock }) {
  const types = new Map(Object.entries(ARRAYS).map(([name, type]) => [type, name]));
  const written = {};
  for (const [name, { components, values }] of fields) {
    written[name] = { type: types.get(values.constructor), components, values: text(values) };
  }
  return { rows, columns, palette: Object.fromEntries(palette), ids: text(ids), fields: written, clock: clock.map(String) };
}
