// Pictures and animations of the world: PNG by the browser, GIF written here, videos in video.js.

const MOST_FRAMES = 120;
const BUDGET = 32 << 20; // bytes of frames that are kept
const LONGER = 8; // times as much for recordings that somebody has begun
const EVERY = 50; // ms between frames

/** Keeps the last seconds, or all since a recording began, with 15 bits a pixel. */
export class Recorder {
  constructor() {
    this.recording = false;
    this.clear();
  }

  /** Begins a recording or ends one. Returns whether one runs. */
  toggle() {
    this.recording = !this.recording;
    if (this.recording) this.clear();
    return this.recording;
  }

  clear() {
    /** @type {Uint16Array[]} */ this.frames = [];
    this.last = -Infinity;
    /** Draws the picture that is shown, if it came too soon after the last frame. */ this.skipped = null;
  }

  /** @param {() => ImageData} draw */
  add(draw, now = performance.now()) {
    this.skipped = now - this.last < EVERY ? draw : null;
    if (this.skipped) return;
    this.last = now;
    this._keep(draw());
  }

  _keep(image) {
    if (this.rows !== image.height || this.columns !== image.width) this.frames = [];
    [this.rows, this.columns] = [image.height, image.width];
    const pixels = new Uint32Array(image.data.buffer);
    const frame = new Uint16Array(pixels.length);
    for (let i = 0; i < pixels.length; i++) {
      const color = pixels[i];
      frame[i] = ((color & 0xf8) << 7) | ((color >> 6) & 0x3e0) | ((color >> 19) & 31);
    }
    this.frames.push(frame);
    const longer = this.recording ? LONGER : 1;
    const most = Math.max(2, longer * Math.min(MOST_FRAMES, Math.floor(BUDGET / frame.byteLength)));
    if (this.frames.length > most) this.frames.shift();
  }

  /** The frames that are there now; `every` is the ms between them. */
  kept() {
    // An animation ends with the picture that is shown.
    if (this.skipped) this._keep(this.skipped());
    this.skipped = null;
    const { rows, columns, frames } = this;
    if (frames.length < 2) throw new Error("Run the world first: there are no frames yet.");
    return { rows, columns, frames: [...frames], every: EVERY };
  }
}

const wide = (five) => (five << 3) | (five >> 2);

/** A frame as a picture. @param {Uint16Array} frame @returns {ImageData} */
export function picture(frame, rows, columns) {
  const found = new ImageData(columns, rows);
  const pixels = new Uint32Array(found.data.buffer);
  for (let i = 0; i < frame.length; i++) {
    const color = frame[i];
    pixels[i] = (255 << 24) | (wide(color & 31) << 16) | (wide((color >> 5) & 31) << 8) | wide(color >> 10);
  }
  return found;
}

/** Lets the page draw a frame of its own. */
export const pause = () => new Promise((resolve) => setTimeout(resolve));

/** The most frequent colors, at most 256, and a table from each 15-bit color to the nearest of them. */
function paletteOf(frames) {
  const counts = new Uint32Array(32768);
  for (const frame of frames) for (const color of frame) counts[color]++;
  const seen = [...counts.keys()].filter((color) => counts[color]).sort((a, b) => counts[b] - counts[a]);
  const palette = seen.slice(0, 256);
  const table = new Uint8Array(32768);
  const parts = (color) => [color >> 10, (color >> 5) & 31, color & 31];
  palette.forEach((color, i) => (table[color] = i));
  for (const color of seen.slice(256)) {
    const [r, g, b] = parts(color);
    let best = Infinity;
    palette.forEach((other, i) => {
      const [x, y, z] = parts(other);
      const far = (r - x) ** 2 + (g - y) ** 2 + (b - z) ** 2;
      if (far < best) [best, table[color]] = [far, i];
    });
  }
  return { colors: palette.map((color) => parts(color).map(wide)), table };
}

/**
 * GIF89a: a header, one palette, and the frames, each compressed by LZW.
 * @param {Recorder} recorder @param {(part: number) => void} progress  told from 0 to 1
 * @returns {Promise<Blob>} an animation of all frames that are kept
 */
export async function gif(recorder, progress = () => {}) {
  const { frames, rows, columns, every } = recorder.kept();
  const factor = Math.max(1, Math.floor(256 / Math.max(rows, columns)));
  const { colors, table } = paletteOf(frames);
  const [width, height] = [columns * factor, rows * factor];
  const two = (n) => [n & 255, n >> 8];
  const ascii = (text) => [...text].map((c) => c.charCodeAt(0));
  const palette = new Uint8Array(768);
  colors.forEach((color, i) => palette.set(color, 3 * i));
  const found = [
    Uint8Array.from([...ascii("GIF89a"), ...two(width), ...two(height), 0xf7, 0, 0]),
    palette,
    Uint8Array.from([0x21, 0xff, 11, ...ascii("NETSCAPE2.0"), 3, 1, 0, 0, 0]),
  ];
  const pixels = new Uint8Array(width * height);
  for (const [i, frame] of frames.entries()) {
    for (let y = 0, to = 0; y < height; y++) {
      const row = Math.floor(y / factor) * columns;
      for (let x = 0; x < width; x++) pixels[to++] = table[frame[row + Math.floor(x / factor)]];
    }
    found.push(Uint8Array.from([0x21, 0xf9, 4, 0, ...two(every / 10), 0, 0]));
    found.push(Uint8Array.from([0x2c, 0, 0, 0, 0, ...two(width), ...two(height), 0, 8]));
    found.push(compressed(pixels), Uint8Array.of(0));
    progress(i / frames.length);
    await pause();
  }
  found.push(Uint8Array.of(0x3b));
  return new Blob(found, { type: "image/gif" });
}

/** LZW as GIF has it, for 8-bit symbols, in blocks of at most 255 bytes, each with its length before it. */
function compressed(symbols) {
  const [clear, end] = [256, 257];
  const out = [];
  let [bits, held, width] = [0, 0, 9];
  const put = (code) => {
    bits |= code << held;
    held += width;
    while (held >= 8) {
      out.push(bits & 255);
      bits >>>= 8;
      held -= 8;
    }
  };
  let codes = new Map();
  let next = 258;
  put(clear);
  let known = symbols[0];
  for (let i = 1; i < symbols.length; i++) {
    const key = (known << 8) | symbols[i];
    const longer = codes.get(key);
    if (longer !== undefined) {
      known = longer;
      continue;
    }
    put(known);
    if (next === 4096) {
      put(clear);
      codes = new Map();
      [next, width] = [258, 9];
    } else {
      if (next === 1 << width) width++;
      codes.set(key, next++);
    }
    known = symbols[i];
  }
  put(known);
  put(end);
  if (held) out.push(bits & 255);
  const found = [];
  for (let i = 0; i < out.length; i += 255) {
    const block = out.slice(i, i + 255);
    found.push(block.length, ...block);
  }
  return Uint8Array.from(found);
}

/** @param {ImageData} image @returns {Promise<Blob>} a PNG, small worlds enlarged */
export async function png(image) {
  const factor = Math.max(1, Math.floor(512 / Math.max(image.width, image.height)));
  const large = document.createElement("canvas");
  [large.width, large.height] = [image.width * factor, image.height * factor];
  const context = large.getContext("2d");
  context.imageSmoothingEnabled = false;
  context.drawImage(await createImageBitmap(image), 0, 0, large.width, large.height);
  return new Promise((resolve) => large.toBlob(resolve, "image/png"));
}

/** Saves a blob as a file of the user's. */
export function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
