// The last seconds as a WebM: the browser encodes the frames, the container is written here.

import { pause, picture } from "./media.js";

const CODECS = [
  ["vp09.00.31.08", "V_VP9"],
  ["vp8", "V_VP8"],
];
const KEY_EVERY = 40; // frames; each of these begins a cluster, so that players can jump there
const BITS = 0.4; // for each pixel and frame: edges of cells stay sharp

/** What this browser encodes pictures of a size with; null if it cannot. */
async function encoding(width, height, bitrate) {
  if (typeof VideoEncoder === "undefined") return null;
  for (const [codec, id] of CODECS) {
    const config = { codec, width, height, bitrate, latencyMode: "quality" };
    if ((await VideoEncoder.isConfigSupported(config).catch(() => null))?.supported) return { config, id };
  }
  return null;
}

/** Why this browser makes no videos; empty if it does. */
export async function missing() {
  if (await encoding(512, 512, 1e6)) return "";
  if (!globalThis.isSecureContext) return "Browsers encode videos on pages from https or localhost only.";
  return "This browser has no encoder for VP8 or VP9 videos.";
}

/** How many pixels a cell gets, so that both sides are even numbers, as encoders want them. */
function scale(rows, columns) {
  const factor = Math.max(1, Math.floor(512 / Math.max(rows, columns)));
  return (rows * factor) % 2 || (columns * factor) % 2 ? factor + 1 : factor;
}

/**
 * @param {import("./media.js").Recorder} recorder
 * @param {(part: number) => void} progress  told from 0 to 1
 * @returns {Promise<Blob>} a film of all frames that are kept
 */
export async function webm(recorder, progress = () => {}) {
  const { frames, rows, columns, every } = recorder.kept();
  const factor = scale(rows, columns);
  const [width, height] = [columns * factor, rows * factor];
  const found = await encoding(width, height, Math.round(((width * height * 1000) / every) * BITS));
  if (!found) throw new Error(await missing());
  const [small, large] = [new OffscreenCanvas(columns, rows), new OffscreenCanvas(width, height)];
  const context = large.getContext("2d");
  context.imageSmoothingEnabled = false;
  const chunks = [];
  let broken = null;
  const encoder = new VideoEncoder({
    output(chunk) {
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      chunks.push({ data, time: Math.round(chunk.timestamp / 1000), key: chunk.type === "key" });
    },
    error: (error) => (broken = error),
  });
  encoder.configure(found.config);
  for (let i = 0; i < frames.length && !broken; i++) {
    small.getContext("2d").putImageData(picture(frames[i], rows, columns), 0, 0);
    context.drawImage(small, 0, 0, width, height);
    const frame = new VideoFrame(large, { timestamp: i * every * 1000, duration: every * 1000 });
    encoder.encode(frame, { keyFrame: i % KEY_EVERY === 0 });
    frame.close();
    progress(i / frames.length);
    // The page keeps drawing, and few frames wait in the encoder.
    do await pause();
    while (encoder.encodeQueueSize > 4 && !broken);
  }
  if (!broken) await encoder.flush();
  if (encoder.state !== "closed") encoder.close();
  if (broken) throw broken;
  return new Blob(container(chunks, { width, height, id: found.id, length: frames.length * every }), { type: "video/webm" });
}

// WebM is Matroska with fewer elements: each has an id, a size and its contents (RFC 8794 and RFC 9559).

/** The bytes of a number, the first one first. */
function number(value, size) {
  return Uint8Array.from({ length: size }, (_, i) => Math.floor(value / 256 ** (size - 1 - i)) % 256);
}

function float(value) {
  const found = new DataView(new ArrayBuffer(8));
  found.setFloat64(0, value);
  return new Uint8Array(found.buffer);
}

/** An element: sizes are written in eight bytes. @param {...(Uint8Array | Uint8Array[])} contents */
function element(id, ...contents) {
  const parts = contents.flat();
  const size = parts.reduce((sum, one) => sum + one.length, 0);
  const width = id > 0xffffff ? 4 : id > 0xffff ? 3 : id > 0xff ? 2 : 1;
  return [number(id, width), Uint8Array.of(1), number(size, 7), ...parts];
}

const word = (text) => new TextEncoder().encode(text);

/** @param {{data: Uint8Array, time: number, key: boolean}[]} chunks  with times in ms */
function container(chunks, { width, height, id, length }) {
  const header = element(
    0x1a45dfa3,
    element(0x4286, number(1, 1)), // version of EBML
    element(0x42f7, number(1, 1)),
    element(0x42f2, number(4, 1)), // longest id and size in bytes
    element(0x42f3, number(8, 1)),
    element(0x4282, word("webm")),
    element(0x4287, number(4, 1)), // version of the document, and the one that is needed to read it
    element(0x4285, number(2, 1)),
  );
  const about = element(
    0x1549a966,
    element(0x2ad7b1, number(1_000_000, 4)), // ns in a unit of time
    element(0x4489, float(length)),
    element(0x4d80, word("powderdsl")),
    element(0x5741, word("powderdsl")),
  );
  const picture = element(0xe0, element(0xb0, number(width, 2)), element(0xba, number(height, 2)));
  const track = element(
    0xae,
    element(0xd7, number(1, 1)), // track number and identity
    element(0x73c5, number(1, 1)),
    element(0x9c, number(0, 1)), // no lacing
    element(0x86, word(id)),
    element(0x83, number(1, 1)), // a video
    element(0x23e383, number((length / chunks.length) * 1_000_000, 4)), // ns of a frame
    picture,
  );
  const clusters = [];
  for (let from = 0, to; from < chunks.length; from = to) {
    to = chunks.findIndex((one, i) => i > from && one.key);
    if (to < 0) to = chunks.length;
    const { time } = chunks[from];
    const blocks = chunks.slice(from, to).flatMap((one) => {
      const head = [Uint8Array.of(0x81), number(one.time - time, 2), Uint8Array.of(one.key ? 0x80 : 0)];
      return element(0xa3, ...head, one.data);
    });
    clusters.push(...element(0x1f43b675, element(0xe7, number(time, 4)), blocks));
  }
  return [...header, ...element(0x18538067, about, element(0x1654ae6b, track), clusters)];
}
