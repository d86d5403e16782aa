// Works as bytes, for links and files: rules, parameters and a world. Browsers send the fragments of links nowhere.

import { ARRAYS } from "./engine.js";
import { BadWorld, MAX_SIDE, bytes, readWorld, text, writeWorld } from "./worlds.js";

const PREFIX = "#w=";
/** Characters of a link that is handed out: Windows passes at most 32,767 from one program to another. */
export const MAX_SHARED = 30_000;
const MAX_LINK = 4 << 20; // characters of one that is opened
const MAX_BYTES = 48 << 20; // after decompression
const MAX_FROM = 16; // earlier links that one names
const MAX_TEXT = 1 << 20; // characters of all files
const FILE = /^[A-Za-z0-9_][A-Za-z0-9_-]{0,60}\.ya?ml$/;

/** `from` names the links that this work came from, the last one first. @typedef {ReturnType<typeof checked>} Shared */

async function squeezed(data, stream) {
  return new Uint8Array(await new Response(new Blob([data]).stream().pipeThrough(stream)).arrayBuffer());
}

async function unsqueezed(data) {
  const reader = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  const parts = [];
  let size = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    size += value.length;
    if (size > MAX_BYTES) {
      await reader.cancel();
      throw new BadWorld("the link holds more than a world");
    }
    parts.push(value);
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

const base64url = (data) => text(data).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");

/**
 * JSON, then a zero, then what is left out there: the ids, then the bytes of each field, all first ones of its numbers before
 * all second ones, since those are alike. Where all are equal, `same` has the byte instead.
 * @param {Shared} shared @returns {Promise<Uint8Array>}
 */
export async function toBytes({ world, ...rest }) {
  const written = writeWorld(world);
  delete written.ids;
  const planes = [world.ids];
  for (const [name, { values }] of world.fields) {
    delete written.fields[name].values;
    const size = values.BYTES_PER_ELEMENT;
    const raw = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
    for (let b = 0; b < size; b++) planes.push(raw.filter((_, i) => i % size === b));
  }
  const same = planes.map((plane) => (plane.every((one) => one === plane[0]) ? plane[0] : -1));
  const head = JSON.stringify({ v: 2, ...rest, world: written, same });
  return squeezed(new Blob([head, "\0", ...planes.filter((_, i) => same[i] < 0)]), new CompressionStream("deflate-raw"));
}

/** Puts the planes of a world back in their places in the JSON, which `readWorld` checks. */
function fillIn(world, same, data) {
  const { rows, columns, fields } = world;
  const isSide = (one) => Number.isInteger(one) && one >= 1 && one <= MAX_SIDE;
  const known = Object.values(fields).every(({ type, components }) => Object.hasOwn(ARRAYS, type) && [1, 2].includes(components));
  if (!isSide(rows) || !isSide(columns) || !known) throw new BadWorld("the link is damaged: a bad world");
  let [at, number] = [0, 0];
  const plane = (length) => {
    const one = same[number++];
    if (one >= 0) return new Uint8Array(length).fill(one);
    at += length;
    return data.subarray(at - length, at);
  };
  world.ids = text(plane(rows * columns));
  for (const field of Object.values(fields)) {
    const size = ARRAYS[field.type].BYTES_PER_ELEMENT;
    const values = new Uint8Array(rows * columns * field.components * size);
    for (let b = 0; b < size; b++) plane(values.length / size).forEach((one, i) => (values[i * size + b] = one));
    field.values = text(values);
  }
}

/** A world whose real numbers have eight binary digits, and are 0 below a thousandth of the largest: nobody sees it. */
export function rounded(world) {
  const fields = new Map(world.fields);
  for (const [name, { components, values }] of fields) {
    if (!(values instanceof Float32Array)) continue;
    const least = values.reduce((most, one) => Math.max(most, Math.abs(one)), 0) / 1000;
    const bits = new Int32Array(values.map((one) => (Math.abs(one) < least ? 0 : one)).buffer);
    fields.set(name, { components, values: new Float32Array(bits.map((one) => (one + 0x8000) & 0xffff0000).buffer) });
  }
  return { ...world, fields };
}

/** @param {Shared} shared @returns {Promise<string>} the fragment */
export const toFragment = async (shared) => PREFIX + base64url(await toBytes(shared));

/** @param {string} fragment @returns {Promise<Shared | null>} null for links without a world. Raises BadWorld. */
export async function fromFragment(fragment) {
  if (!fragment.startsWith(PREFIX)) return null;
  const coded = fragment.slice(PREFIX.length);
  if (coded.length > MAX_LINK) throw new BadWorld("the link is too long");
  if (!/^[A-Za-z0-9_-]*$/.test(coded)) throw new BadWorld("the link is damaged: it has other characters than links have");
  const found = await fromBytes(() => bytes(coded.replaceAll("-", "+").replaceAll("_", "/")));
  return { ...found, from: [nameOf(coded), ...found.from].slice(0, MAX_FROM) };
}

/** A short name of a link: a hash (FNV-1a, forwards and backwards). */
function nameOf(coded) {
  const hash = (text) => [...text].reduce((found, one) => Math.imul(found ^ one.charCodeAt(0), 0x01000193), 0x811c9dc5) >>> 0;
  return [coded, [...coded].reverse().join("")].map((one) => hash(one).toString(16).padStart(8, "0")).join("");
}

/** @param {() => Uint8Array} read @returns {Promise<Shared>} */
export async function fromBytes(read) {
  let found;
  try {
    const data = await unsqueezed(read());
    const end = data.indexOf(0); // the first version had no planes
    found = JSON.parse(new TextDecoder().decode(end < 0 ? data : data.subarray(0, end)));
    if (found.v === 2) fillIn(found.world, found.same, data.subarray(end + 1));
  } catch (error) {
    if (error instanceof BadWorld) throw error;
    throw new BadWorld("the link is damaged: a part of it is missing or changed");
  }
  return checked(found);
}

function checked(data) {
  const expect = (holds, problem) => {
    if (!holds) throw new BadWorld(`the link is damaged: ${problem}`);
  };
  const plain = (value) => typeof value === "object" && value !== null && !Array.isArray(value);
  expect(plain(data), "it holds no object");
  expect(data.v === 1 || data.v === 2, "it was made by another version of this page");
  expect(typeof data.key === "string" && /^[A-Za-z0-9_-]{1,80}$/.test(data.key), "it names no rules");
  const files = data.files ?? null;
  if (files !== null) {
    expect(plain(files) && Object.keys(files).length <= 64, "too many files");
    let size = 0;
    for (const [name, text] of Object.entries(files)) {
      expect(FILE.test(name) && (text === null || typeof text === "string"), "a file has a bad name or text");
      size += text?.length ?? 0;
    }
    expect(size <= MAX_TEXT, "its files are too long");
  }
  const off = data.off ?? [];
  expect(Array.isArray(off) && off.length <= 64 && off.every((one) => typeof one === "string"), "a bad list of packs");
  const parameters = data.parameters ?? {};
  expect(plain(parameters) && Object.values(parameters).every(Number.isFinite), "a bad parameter");
  const from = data.from ?? [];
  expect(Array.isArray(from) && from.length <= MAX_FROM && from.every((one) => /^[0-9a-f]{16}$/.test(one)), "a bad origin");
  return { key: data.key, files, off, parameters, from, world: readWorld(data.world) };
}
