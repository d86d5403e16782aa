// A world that runs in a WebAssembly module: docs/export.md describes the functions of such modules.

/** @typedef {{color: string, full: number, most: number}} TintAbout */
/** @typedef {{name: string, qualified: string, kind: string, type: string, components: number, tint?: TintAbout}} FieldAbout */
/** @typedef {{field: string, start: string, end: string, low: number, high: number}} RampAbout */
/** @typedef {{id: number, name: string, qualified: string, color: string, glyph: string, ramp?: RampAbout}} ElementAbout */
/** @typedef {{name: string, kind: string, value: number, low: number, high: number, about: string}} ParameterAbout */
/**
 * Everything that the future of a world depends on, independent of the numbers that rules give their elements.
 * @typedef {{rows: number, columns: number, palette: Map<number, string>, ids: Uint8Array,
 *   fields: Map<string, {components: number, values: ArrayLike<number>}>, clock: bigint[]}} Snapshot
 */

export const ARRAYS = { uint8: Uint8Array, int8: Int8Array, int16: Int16Array, int32: Int32Array, float32: Float32Array };

/** Reads what a module says about itself. */
export function aboutOf(module) {
  const [section] = WebAssembly.Module.customSections(module, "powderdsl");
  return JSON.parse(new TextDecoder().decode(section));
}

export class Engine {
  /** @param {WebAssembly.Module} module */
  static async start(module) {
    return new Engine(module, await WebAssembly.instantiate(module));
  }

  constructor(module, instance) {
    this.module = module;
    this.about = aboutOf(module);
    this.calls = instance.exports;
    /** @type {ElementAbout[]} */ this.elements = this.about.elements;
    /** @type {FieldAbout[]} */ this.fields = this.about.fields;
    /** @type {ParameterAbout[]} */ this.parameters = this.about.parameters;
    this.rows = this.about.rows;
    this.columns = this.about.columns;
    this.cells = this.rows * this.columns;
    this.byId = new Map(this.elements.map((one) => [one.id, one]));
    /** The vector field that people drag: one that pictures show, or the first one. */
    this.motion = this.fields.findIndex((one) => one.tint);
    if (this.motion < 0) this.motion = this.fields.findIndex((one) => one.kind === "vec2");
    this.values = this.parameters.map((one) => one.value);
  }

  get ground() {
    return this.elements[0].id;
  }

  /** The memory at an address that a call has returned: the call may have made the memory grow, so it comes first. */
  _view(type, address, length) {
    return new type(this.calls.memory.buffer, address, length);
  }

  /** The ids as they are: a view, valid until the next call. */
  ids() {
    return this._view(Uint8Array, this.calls.show(), this.cells);
  }

  /** The values of a field: a view, valid until the next call. Components follow each other. */
  field(number) {
    const { type, components } = this.fields[number];
    return this._view(ARRAYS[type], this.calls.field(number), this.cells * components);
  }

  step(count = 1) {
    this.calls.step(count);
  }

  /** Seed, index and step. */
  clock() {
    return [...this._view(BigInt64Array, this.calls.clock(), 3)];
  }

  /** Starts anew with these ids, whose fields have their usual values. */
  begin(ids, seed) {
    this._view(Uint8Array, this.calls.cells(), this.cells).set(ids);
    this.calls.begin(seed);
  }

  reseed(seed) {
    this._view(BigInt64Array, this.calls.clock(), 3)[0] = BigInt(seed);
  }

  setParameter(number, value) {
    this.values[number] = value;
    this.calls.parameter(number, value);
  }

  /** Fresh cells of an element where `mask` (a byte a cell) is not 0. */
  paint(element, mask) {
    for (const [row, left, right] of runs(mask, this.columns)) this.calls.paint(element, row, row + 1, left, right);
  }

  /** Gives a field's components values where `mask` is not 0; the rules may cut them. */
  setField(number, mask, values, { add = false } = {}) {
    this.calls.show();
    const view = this.field(number);
    values.forEach((value, component) => {
      const base = component * this.cells;
      for (let i = 0; i < mask.length; i++) if (mask[i]) view[base + i] = (add ? view[base + i] : 0) + value;
    });
    this.calls.take(number);
  }

  /** How many cells each element has, by id. */
  counts(ids = this.ids()) {
    const found = new Uint32Array(256);
    for (let i = 0; i < ids.length; i++) found[ids[i]]++;
    return found;
  }

  /** @returns {Snapshot} */
  snapshot() {
    const fields = new Map();
    this.fields.forEach((one, number) => {
      const values = this.field(number).slice();
      fields.set(one.qualified, { components: one.components, values });
    });
    const palette = new Map(this.elements.map((one) => [one.id, one.qualified]));
    const ids = this.ids().slice();
    return { rows: this.rows, columns: this.columns, palette, ids, fields, clock: this.clock() };
  }

  /**
   * Continues a world, whatever rules it comes from: elements and fields are matched by their qualified names. A world
   * of another size is cut, or stands on the bottom of this one in the middle.
   * @param {Snapshot} from
   * @returns {string[]} the names of elements and fields that these rules lack
   */
  restore(from) {
    const lost = new Set();
    const ours = new Map(this.elements.map((one) => [one.qualified, one.id]));
    const table = new Uint8Array(256).fill(this.ground);
    const known = new Uint8Array(256);
    for (const [id, name] of from.palette) {
      if (ours.has(name)) [table[id], known[id]] = [ours.get(name), 1];
    }
    const place = this._placing(from);
    const ids = new Uint8Array(this.cells).fill(this.ground);
    place((to, at) => {
      const id = from.ids[at];
      if (!known[id]) lost.add(from.palette.get(id) ?? `element ${id}`);
      ids[to] = table[id];
    });
    this.begin(ids, 0);
    for (const [name, { components, values }] of from.fields) {
      const number = this.fields.findIndex((one) => one.qualified === name);
      if (number < 0 || this.fields[number].components !== components) {
        if (Array.prototype.some.call(values, Boolean)) lost.add(name);
        continue;
      }
      const names = this.fields[number].kind === "element";
      const view = this.field(number);
      const theirs = from.rows * from.columns;
      for (let component = 0; component < components; component++) {
        place((to, at) => {
          const value = values[component * theirs + at];
          view[component * this.cells + to] = names ? table[value] : value;
        });
      }
      this.calls.take(number);
    }
    this._view(BigInt64Array, this.calls.clock(), 3).set(from.clock);
    return [...lost];
  }

  /**
   * Continues a world of another size. If it has an edge of the element `frame`, that edge moves to the new one.
   * @param {Snapshot} from @param {number | null} frame
   */
  fit(from, frame) {
    const edge = [...edgeOf(from)];
    const isFramed = frame !== null && edge.every((at) => from.ids[at] === frame);
    const ids = from.ids.slice();
    if (isFramed) for (const at of edge) ids[at] = this.ground;
    this.restore({ ...from, ids });
    if (!isFramed) return;
    const mask = new Uint8Array(this.cells);
    for (const at of edgeOf(this)) mask[at] = 1;
    this.paint(frame, mask);
  }

  /** A function that calls its argument with each pair of places: of a cell here, and of the same cell there. */
  _placing({ rows, columns }) {
    const down = this.rows - rows;
    const right = Math.floor((this.columns - columns) / 2);
    return (visit) => {
      for (let y = Math.max(0, -down); y < Math.min(rows, this.rows - down); y++) {
        for (let x = Math.max(0, -right); x < Math.min(columns, this.columns - right); x++) {
          visit((y + down) * this.columns + x + right, y * columns + x);
        }
      }
    };
  }
}

/** The horizontal runs of a mask: row, first column, column after the last. */
export function* runs(mask, columns) {
  for (let start = 0; start < mask.length; start += columns) {
    let left = -1;
    for (let x = 0; x <= columns; x++) {
      const inside = x < columns && mask[start + x];
      if (inside && left < 0) left = x;
      if (!inside && left >= 0) {
        yield [start / columns, left, x];
        left = -1;
      }
    }
  }
}

/** A snapshot with every cell as `factor`×`factor` cells. @param {Snapshot} from @returns {Snapshot} */
export function enlarged(from, factor) {
  return grown(from, factor, factor, (at) => Math.floor(at / factor));
}

/** Copies of a snapshot, `down` below each other and `right` beside each other. @param {Snapshot} from @returns {Snapshot} */
export function tiled(from, down, right) {
  return grown(from, down, right, (at, side) => at % side);
}

/** `source` says from which row or column, of so many, one comes. */
function grown(from, down, right, source) {
  const [rows, columns] = [from.rows * down, from.columns * right];
  const grow = (values, components) => {
    const found = new values.constructor(rows * columns * components);
    let to = 0;
    for (let c = 0; c < components; c++)
      for (let y = 0; y < rows; y++) {
        const row = (c * from.rows + source(y, from.rows)) * from.columns;
        for (let x = 0; x < columns; x++) found[to++] = values[row + source(x, from.columns)];
      }
    return found;
  };
  const fields = new Map();
  for (const [name, { components, values }] of from.fields)
    fields.set(name, { components, values: grow(values, components) });
  return { ...from, rows, columns, ids: grow(from.ids, 1), fields };
}

/** Moments before changes, so that they can be undone: as many as fit into some memory. */
export class History {
  constructor(limit = 96 * 2 ** 20) {
    this.limit = limit;
    this.clear();
  }

  clear() {
    /** @type {import("./work.js").Moment[]} */ this.past = [];
    /** @type {import("./work.js").Moment[]} */ this.future = [];
  }

  /** Remembers what is about to change. */
  keep(moment) {
    this.past.push(moment);
    this.future = [];
    let size = 0;
    let kept = 0;
    let before = null;
    for (const { module, world } of [...this.past].reverse()) {
      size += world.ids.byteLength + (module === before ? 0 : MODULE);
      for (const { values } of world.fields.values()) size += values.byteLength;
      before = module;
      if (size > this.limit && kept) break;
      kept++;
    }
    this.past = this.past.slice(-kept);
  }

  /** The moment that undo or redo leads to. */
  next(way) {
    return (way === "undo" ? this.past : this.future).at(-1);
  }

  /** Goes there, in exchange for the present moment. */
  go(way, present) {
    const [from, to] = way === "undo" ? [this.past, this.future] : [this.future, this.past];
    from.pop();
    to.push(present);
  }
}

const MODULE = 2 ** 20; // bytes, more or less, of a compiled module

/**
 * Shapes at random places, other ones for each seed (a bigint): 24 disks, boxes and lines of all elements, framed if the rules move
 * anything.
 */
export function scatter(engine, frame, seed) {
  const { rows, columns, elements } = engine;
  const ids = new Uint8Array(rows * columns).fill(engine.ground);
  const random = generator(Number(seed & 0xffffffffn) ^ Number(seed >> 32n));
  const below = (n) => Math.floor(random() * n);
  const reach = Math.max(2, Math.floor(Math.min(rows, columns) / 8));
  for (let n = 0; n < 24 && elements.length > 1; n++) {
    const element = elements[1 + below(elements.length - 1)].id;
    const [y, x, a, b] = [below(rows), below(columns), 1 + below(reach), 1 + below(reach)];
    const sparse = random() < 0.5;
    const round = random() < 0.5;
    for (let i = -b; i <= b; i++)
      for (let j = -a; j <= a; j++) {
        const [row, column] = [y + i, x + j];
        if (row < 0 || column < 0 || row >= rows || column >= columns) continue;
        if ((round && i * i * a * a + j * j * b * b > a * a * b * b) || (sparse && random() < 0.5)) continue;
        ids[row * columns + column] = element;
      }
  }
  return framed(ids, engine, frame);
}

/** The places of the cells at the edge. */
function* edgeOf({ rows, columns }) {
  for (let y = 0; y < rows; y++)
    for (let x = 0; x < columns; x += y % (rows - 1) && columns > 1 ? columns - 1 : 1) yield y * columns + x;
}

/** Ids with an edge of the element `frame`, so that nothing falls out; null for rules that need none. */
export function framed(ids, { rows, columns }, frame) {
  if (frame === null) return ids;
  for (const at of edgeOf({ rows, columns })) ids[at] = frame;
  return ids;
}

/** Numbers from 0 to 1: a small hash of a counter, for start worlds and sprays only. */
export function generator(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x9e3779b9) >>> 0;
    let mixed = state;
    mixed = Math.imul(mixed ^ (mixed >>> 16), 0x21f0aaad);
    mixed = Math.imul(mixed ^ (mixed >>> 15), 0x735a2d97);
    return ((mixed ^ (mixed >>> 15)) >>> 0) / 2 ** 32;
  };
}
