// Links that hold rules, parameters and a world in their fragment, which browsers send nowhere.

import { BadWorld, readWorld, writeWorld } from "./worlds.js";

const PREFIX = "#w=";
const MAX_LINK = 4 << 20; // characters
const MAX_JSON = 24 << 20; // bytes after decompression
const MAX_TEXT = 1 << 20; // characters of all files
const FILE = /^[A-Za-z0-9_][A-Za-z0-9_-]{0,60}\.ya?ml$/;

/**
 * @typedef {{key: string, files: Record<string, string | null> | null, off: string[],
 *   parameters: Record<string, number>, world: import("./engine.js").Snapshot}} Shared
 */

async function squeezed(data, stream) {
  return new Uint8Array(await new Response(new Blob([data]).stream().pipeThrough(stream)).arrayBuffer());
}

/** Decompresses at most `limit` bytes. */
async function unsqueezed(data, limit) {
  const reader = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  const parts = [];
  let size = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    size += value.length;
    if (size > limit) {
      await reader.cancel();
      throw new BadWorld("the link holds more than a world");
    }
    parts.push(value);
  }
  return new Blob(parts).text();
}

function base64url(data) {
  let found = "";
  for (let i = 0; i < data.length; i += 32768) found += String.fromCharCode(...data.subarray(i, i + 32768));
  return btoa(found).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

/** @param {Shared} shared @returns {Promise<string>} the fragment */
export async function toFragment({ key, files, off, parameters, world }) {
  const written = JSON.stringify({ v: 1, key, files, off, parameters, world: writeWorld(world) });
  return PREFIX + base64url(await squeezed(new TextEncoder().encode(written), new CompressionStream("deflate-raw")));
}

/** @param {string} fragment @returns {Promise<Shared | null>} null for links without a world. Raises BadWorld. */
export async function fromFragment(fragment) {
  if (!fragment.startsWith(PREFIX)) return null;
  const coded = fragment.slice(PREFIX.length);
  if (coded.length > MAX_LINK) throw new BadWorld("the link is too long");
  if (!/^[A-Za-z0-9_-]*$/.test(coded)) throw new BadWorld("the link is damaged: it has other characters than links have");
  let data;
  try {
    const raw = Uint8Array.from(atob(coded.replaceAll("-", "+").replaceAll("_", "/")), (c) => c.charCodeAt(0));
    data = JSON.parse(await unsqueezed(raw, MAX_JSON));
  } catch (error) {
    if (error instanceof BadWorld) throw error;
    throw new BadWorld("the link is damaged: a part of it is missing or changed");
  }
  return checked(data);
}

function checked(data) {
  const expect = (holds, problem) => {
    if (!holds) throw new BadWorld(`the link is damaged: ${problem}`);
  };
  const plain = (value) => typeof value === "object" && value !== null && !Array.isArray(value);
  expect(plain(data), "it holds no object");
  expect(data.v === 1, "it was made by another version of this page");
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
  return { key: data.key, files, off, parameters, world: readWorld(data.world) };
}
