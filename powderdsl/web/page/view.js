// A canvas that shows a world as `powderdsl render` draws it, and the brush on it.

import { generator } from "./engine.js";

const { fround } = Math;

/** @returns {number[]} red, green, blue */
export function channels(color) {
  const number = parseInt(color.slice(1), 16);
  return [number >> 16, (number >> 8) & 255, number & 255];
}

const packed = ([red, green, blue]) => (255 << 24) | (blue << 16) | (green << 8) | red;

/** Draws worlds into an ImageData of their size. */
export class Painter {
  /** @param {import("./engine.js").Engine} engine @param {Map<number, string>} colors  other colors, by id */
  constructor(engine, colors = new Map()) {
    this.engine = engine;
    this.image = new ImageData(engine.columns, engine.rows);
    this.pixels = new Int32Array(this.image.data.buffer);
    /** The channels; unlike those of an ImageData, they are rounded down. */
    this.bytes = new Uint8Array(this.image.data.buffer);
    this.table = new Int32Array(256);
    this.ramps = [];
    for (const { id, color, ramp } of engine.elements) {
      this.table[id] = packed(channels(colors.get(id) ?? color));
      const field = ramp ? engine.fields.findIndex((one) => one.name === ramp.field) : -1;
      if (field >= 0 && !colors.has(id)) this.ramps.push({ id, field, ramp, known: new Map() });
    }
  }

  /** @returns {ImageData} the world as it is; with `tint`, vectors tint cells */
  draw(tint = true) {
    const { engine, pixels, table } = this;
    const ids = engine.ids();
    for (let i = 0; i < ids.length; i++) pixels[i] = table[ids[i]];
    for (const one of this.ramps) {
      const values = engine.field(one.field);
      const cells = engine.ids();
      for (let i = 0; i < cells.length; i++) if (cells[i] === one.id) pixels[i] = this._ramped(one, values[i]);
    }
    if (tint) engine.fields.forEach((one, number) => one.tint && this._tint(engine.field(number), one.tint));
    return this.image;
  }

  /** The color of a value: channels change by one where the value has passed the middle between two of them. */
  _ramped({ ramp, known }, value) {
    let found = known.get(value);
    if (found === undefined) {
      const part = (Math.min(Math.max(value, ramp.low), ramp.high) - ramp.low) / (ramp.high - ramp.low);
      const end = channels(ramp.end);
      found = packed(
        channels(ramp.start).map((from, i) => {
          const by = end[i] - from;
          return by > 0 ? from + Math.floor(by * part + 0.5) : from - Math.max(0, Math.ceil(-by * part - 0.5));
        }),
      );
      if (known.size > 4096) known.clear();
      known.set(value, found);
    }
    return found;
  }

  /** Each operation is one of float32, as in `tint_cells` of simulation/draw.py. */
  _tint(values, tint) {
    const { bytes } = this;
    const { cells } = this.engine;
    const most = fround(tint.most);
    const shares = channels(tint.color).map((part) => fround(part / 255));
    for (let i = 0; i < cells; i++) {
      const [down, right] = [values[i], values[cells + i]];
      if (down === 0 && right === 0) continue;
      const length = fround(Math.sqrt(fround(fround(down * down) + fround(right * right))));
      const share = Math.min(fround(length / tint.full), most);
      const rest = fround(1 - share);
      for (let c = 0; c < 3; c++) {
        const own = fround(fround(bytes[4 * i + c] / 255) * rest);
        bytes[4 * i + c] = fround(fround(own + fround(share * shares[c])) * 255);
      }
    }
  }
}

const CORNERS = `#version 300 es
void main() { gl_Position = vec4(ivec2(gl_VertexID & 1, gl_VertexID >> 1) * 4 - 1, 0, 1); }`;
const CELLS = `#version 300 es
precision highp float;
precision highp sampler2D;
precision highp usampler2D;
uniform usampler2D ids;
uniform sampler2D colors, vectors; // of elements; the rows of one component, then those of the other
uniform bool drawn, tints; // drawn: colors are those of cells
uniform vec3 shares;
uniform float full, most;
out vec4 pixel;
void main() {
  int rows = textureSize(ids, 0).y;
  ivec2 at = ivec2(int(gl_FragCoord.x), rows - 1 - int(gl_FragCoord.y));
  vec3 color = texelFetch(colors, drawn ? at : ivec2(texelFetch(ids, at, 0).r, 0), 0).rgb;
  vec2 vector = tints ? vec2(texelFetch(vectors, at, 0).r, texelFetch(vectors, at + ivec2(0, rows), 0).r) : vec2(0);
  if (vector != vec2(0)) {
    float share = min(sqrt(vector.x * vector.x + vector.y * vector.y) / full, most);
    color = floor((color * (1.0 - share) + share * shares) * 255.0) / 255.0;
  }
  pixel = vec4(color, 1);
}`;

/** Whether there is a GPU: WebGL that runs on the processor is slower than a 2D canvas. */
function accelerated() {
  const gl = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  const name = gl?.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return Boolean(gl) && !/swiftshader|llvmpipe|software|basic render/i.test(name);
}

/** Puts worlds on a canvas: by the GPU where there is one, otherwise as a Painter draws them. */
export class Screen {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas, fast = accelerated()) {
    this.canvas = canvas;
    this.gl = fast && canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true });
    if (this.gl) this._build();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this._build();
      this.show(...this.shown);
    });
  }

  _build() {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, CORNERS], [gl.FRAGMENT_SHADER, CELLS]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    const names = ["ids", "colors", "vectors", "drawn", "tints", "shares", "full", "most"];
    this.places = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    names.slice(0, 3).forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
      gl.uniform1i(this.places[name], unit);
    });
  }

  /** @param {Painter} painter */
  show(painter, tint) {
    const { gl, places } = this;
    if (!gl) {
      this.canvas.getContext("2d").putImageData(painter.draw(tint), 0, 0);
      return;
    }
    this.shown = [painter, tint];
    const { engine, table } = painter;
    const { rows, columns } = engine;
    const put = (unit, inside, height, format, type, data, width = columns) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, type, data);
    };
    const tinting = tint ? engine.fields.filter((one) => one.tint) : [];
    const drawn = painter.ramps.length > 0 || tinting.length > 1;
    put(0, gl.R8UI, rows, gl.RED_INTEGER, gl.UNSIGNED_BYTE, engine.ids());
    if (drawn) put(1, gl.RGBA8, rows, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(painter.draw(tint).data.buffer));
    else put(1, gl.RGBA8, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(table.buffer), 256);
    gl.uniform1i(places.drawn, Number(drawn));
    gl.uniform1i(places.tints, Number(!drawn && tinting.length));
    if (!drawn && tinting.length) {
      const { color, full, most } = tinting[0].tint;
      put(2, gl.R32F, 2 * rows, gl.RED, gl.FLOAT, engine.field(engine.fields.indexOf(tinting[0])));
      gl.uniform3fv(places.shares, channels(color).map((part) => part / 255));
      gl.uniform1f(places.full, full);
      gl.uniform1f(places.most, most);
    }
    gl.viewport(0, 0, columns, rows);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

/** The picture that a screen shows, without drawing it again. @param {Screen} screen @param {Painter} painter */
export function image({ gl }, painter, tint) {
  if (!gl) return painter.draw(tint);
  const { rows, columns } = painter.engine;
  const upward = new Uint8Array(4 * rows * columns);
  gl.readPixels(0, 0, columns, rows, gl.RGBA, gl.UNSIGNED_BYTE, upward);
  const found = new ImageData(columns, rows);
  for (let y = 0; y < rows; y++) found.data.set(upward.subarray(4 * columns * (rows - 1 - y), 4 * columns * (rows - y)), 4 * columns * y);
  return found;
}

const random = generator(Date.now());

/**
 * Marks the cells of a brush at (row, column) in a mask.
 * @param {Uint8Array} mask @param {{shape: string, size: number}} brush
 */
export function stamp(mask, rows, columns, row, column, { shape, size }) {
  const low = -Math.floor((size - 1) / 2);
  const middle = low + (size - 1) / 2;
  for (let i = low; i < low + size; i++)
    for (let j = low; j < low + size; j++) {
      const [y, x] = [row + i, column + j];
      if (y < 0 || x < 0 || y >= rows || x >= columns) continue;
      const outside = (i - middle) ** 2 + (j - middle) ** 2 > (size / 2) ** 2;
      if (shape !== "square" && outside) continue;
      if (shape === "spray" && random() > 0.15) continue;
      mask[y * columns + x] = 1;
    }
}

/** Marks the cells of a brush that moves from one cell to another. */
export function stroke(mask, rows, columns, from, to, brush) {
  const count = Math.max(Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1]), 1);
  for (let n = 0; n <= count; n++) {
    const row = Math.round(from[0] + ((to[0] - from[0]) * n) / count);
    const column = Math.round(from[1] + ((to[1] - from[1]) * n) / count);
    stamp(mask, rows, columns, row, column, brush);
  }
}

/** Marks all cells of one element that are connected with a cell by sides. */
export function region(mask, rows, columns, row, column, ids) {
  const element = ids[row * columns + column];
  const waiting = [row * columns + column];
  while (waiting.length) {
    const at = waiting.pop();
    if (mask[at] || ids[at] !== element) continue;
    mask[at] = 1;
    const x = at % columns;
    if (x > 0) waiting.push(at - 1);
    if (x < columns - 1) waiting.push(at + 1);
    if (at >= columns) waiting.push(at - columns);
    if (at < (rows - 1) * columns) waiting.push(at + columns);
  }
}

const EDGE = 15; // pixels above and below the lines of a chart, for words
const LEAST = 100; // points that a chart has room for

/** Lines of counts over time with a scale, and a mark at one of the points. @param {{color: string, values: number[]}[]} lines */
export function chart(canvas, steps, lines, at) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const largest = Math.max(1, ...lines.flatMap((one) => one.values));
  const x = (i) => (i * (width - 2)) / Math.max(steps.length - 1, LEAST) + 1;
  // The square root shows small counts beside large ones.
  const y = (count) => height - EDGE - Math.sqrt(count / largest) * (height - 2 * EDGE);
  const { color, fontFamily } = getComputedStyle(canvas);
  [context.font, context.fillStyle, context.strokeStyle] = [`11px ${fontFamily}`, color, color];
  for (const count of new Set([0, Math.round(largest / 4), largest])) {
    context.globalAlpha = 0.3;
    context.fillRect(0, Math.round(y(count)), width, 1);
    context.globalAlpha = 1;
    if (count) context.fillText(count.toLocaleString("en"), 4, y(count) - 3);
  }
  context.fillText(`step ${steps[0]}`, 4, height - 3);
  context.textAlign = "right";
  if (steps.length > 1) context.fillText(steps.at(-1), Math.max(x(steps.length - 1), 120), height - 3);
  if (at >= 0) context.fillRect(x(at), 0, 1, height);
  context.lineWidth = 1.5;
  for (const { color: own, values } of lines) {
    context.strokeStyle = own;
    context.beginPath();
    values.forEach((count, i) => context.lineTo(x(i), y(count)));
    context.stroke();
  }
}

/** The point of a chart at so many pixels from its left. */
export const chartPoint = (canvas, left, count) =>
  Math.max(0, Math.min(count - 1, Math.round(((left - 1) * Math.max(count - 1, LEAST)) / (canvas.clientWidth - 2))));

/** What people do on the canvas, with a pointer, a finger or the keyboard, in cells. */
export class Surface {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{start: Function, move: Function, end: Function, cancel: Function, hover: Function, leave: Function}} events
   */
  constructor(canvas, events) {
    this.canvas = canvas;
    this.events = events;
    /** Fingers on the canvas, by id: two of them move and zoom it. @type {Map<number, number[]>} */ this.fingers = new Map();
    this.zoom = { scale: 1, left: 0, top: 0 };
    /** @type {number[] | null} */ this.cursor = null;
    let active = null;
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button > 0 && event.button !== 2) return;
      if (event.pointerType === "touch") this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (this.fingers.size > 1) {
        if (active !== null) events.cancel();
        active = null;
        return;
      }
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      active = event.pointerId;
      events.start(this.cell(event), { erases: event.button === 2, picks: event.altKey });
      event.preventDefault();
    });
    canvas.addEventListener("pointermove", (event) => {
      if (this.fingers.size > 1) return this._pinch(event);
      const cell = this.cell(event);
      events.hover(cell);
      if (event.pointerId !== active) return;
      const passed = event.getCoalescedEvents?.() ?? [];
      for (const one of passed.length ? passed : [event]) events.move(this.cell(one));
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => {
        this.fingers.delete(event.pointerId);
        if (event.pointerId === active) events.end();
        if (event.pointerId === active) active = null;
      });
    }
    canvas.addEventListener(
      "wheel",
      (event) => {
        // Two fingers on a touchpad: apart with Ctrl, beside each other without.
        if (!event.ctrlKey && this.zoom.scale === 1) return;
        event.preventDefault();
        const from = [event.clientX, event.clientY];
        if (event.ctrlKey) this._move(from, from, Math.exp(-event.deltaY / 100));
        else this._move(from, [from[0] - event.deltaX, from[1] - event.deltaY], 1);
      },
      { passive: false },
    );
    canvas.addEventListener("pointerleave", () => events.leave());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this._key(event));
    canvas.addEventListener("blur", () => (this.cursor = null));
  }

  /** One of two fingers moves: the world follows both. */
  _pinch({ pointerId, clientX, clientY }) {
    if (!this.fingers.has(pointerId)) return;
    const measured = () => {
      const [[a, b], [c, d]] = this.fingers.values();
      return [[(a + c) / 2, (b + d) / 2], Math.hypot(a - c, b - d)];
    };
    const [from, before] = measured();
    this.fingers.set(pointerId, [clientX, clientY]);
    const [to, after] = measured();
    this._move(from, to, after / Math.max(before, 1));
  }

  /** Zooms by a factor, and takes what was at one place of the window to another. */
  _move(from, to, factor) {
    const { canvas, zoom } = this;
    const box = canvas.getBoundingClientRect();
    const scale = Math.min(Math.max(zoom.scale * factor, 1), 16);
    const follow = (side, origin, axis, size) => {
      const moved = to[axis] - (origin - zoom[side]) - ((from[axis] - origin) * scale) / zoom.scale;
      return Math.min(0, Math.max(moved, size * (1 - scale)));
    };
    const left = follow("left", box.left, 0, canvas.offsetWidth);
    this.zoom = { scale, left, top: follow("top", box.top, 1, canvas.offsetHeight) };
    for (const one of canvas.parentElement.children) one.style.transform = `translate(${left}px, ${this.zoom.top}px) scale(${scale})`;
  }

  /** Row and column of an event; they may lie outside while a stroke leaves the canvas. */
  cell(event) {
    const box = this.canvas.getBoundingClientRect();
    return [
      Math.floor(((event.clientY - box.top) / box.height) * this.canvas.height),
      Math.floor(((event.clientX - box.left) / box.width) * this.canvas.width),
    ];
  }

  _key(event) {
    const moves = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    const { height, width } = this.canvas;
    this.cursor ??= event.key in moves || event.key === "Enter" ? [height >> 1, width >> 1] : null;
    if (event.key in moves) {
      const by = event.shiftKey ? 8 : 1;
      const [down, right] = moves[event.key];
      const row = Math.min(Math.max(this.cursor[0] + by * down, 0), height - 1);
      this.cursor = [row, Math.min(Math.max(this.cursor[1] + by * right, 0), width - 1)];
      this.events.hover(this.cursor);
    } else if (event.key === "Enter") {
      this.events.start(this.cursor, {});
      this.events.end();
    } else return;
    event.preventDefault();
  }
}
