// A task that is played: what actions do to its world, and what they earn. The numbers are those of `powderdsl evaluate`.

import { Engine } from "./engine.js";
import { bytes, readWorld } from "./worlds.js";

const AIMS = 9; // directions of blowing: row by row, from up left to down right
const CODE = "0123456789abcdefghijklmnopqrstuvwxyz";

const OPS = {
  add: (a, b) => a + b, sub: (a, b) => a - b, mul: (a, b) => a * b, div: (a, b) => (b ? a / b : 0), neg: (a) => -a,
  quotient: (a, b) => (b ? Math.floor(a / b) : 0), mod: (a, b) => (b ? a - b * Math.floor(a / b) : 0),
  abs: Math.abs, min: Math.min, max: Math.max, choose: (condition, yes, no) => (condition ? yes : no),
  lt: (a, b) => Number(a < b), le: (a, b) => Number(a <= b), eq: (a, b) => Number(a === b),
  and: (a, b) => a * b, or: Math.max, not: (a) => 1 - a,
};

/** The value of an expression of a goal. */
function value(scalar, facts) {
  if (typeof scalar === "number") return scalar;
  const [op, ...args] = scalar;
  if (op === "measure") return facts.now[args[0]];
  if (op === "action") return facts.action[args[0]];
  if (op === "start" || op === "before") return value(args[0], { ...facts, now: facts[op] });
  return OPS[op](...args.map((one) => value(one, facts)));
}

export class Judge {
  /** @param {any} task  what the site has of it @param {number} number  of the start world @param {WebAssembly.Module} module */
  static async start(task, number, module) {
    return new Judge(task, number, await Engine.start(module));
  }

  constructor(task, number, engine) {
    const { regions, world } = task.starts[number];
    // Each world has its rules, and with them its choices and what is counted.
    Object.assign(this, { task: { ...task, ...task.starts[number] }, number, engine });
    this.regions = Object.fromEntries(Object.entries(regions).map(([name, cells]) => [name, bytes(cells)]));
    engine.restore(readWorld(world));
    this.ids = new Map(engine.elements.map((one) => [one.qualified, one.id]));
    this.first = this.before = this._measured();
    /** @type {number[][]} actions: column and row of the bin, choice, direction */ this.actions = [];
    Object.assign(this, { total: 0, over: false, success: false });
  }

  get left() {
    return this.task.actions - this.actions.length;
  }

  /** Top, bottom, left and right of the block that an action at a bin changes; the ends lie beyond it. */
  box([x, y]) {
    const { brush, bins } = this.task;
    const sides = [this.engine.rows, this.engine.columns];
    return [y, x].flatMap((bin, axis) => {
      const first = Math.floor(((2 * bin + 1) * sides[axis]) / (2 * bins[axis])) - Math.floor(brush[axis] / 2);
      return [first, first + brush[axis]].map((line) => Math.min(Math.max(line, 0), sides[axis]));
    });
  }

  /** The column and row of the bin of a cell. */
  bin([row, column]) {
    const [down, across] = this.task.bins;
    const place = (at, bins, side) => Math.min(Math.max(Math.floor((at * bins) / side), 0), bins - 1);
    return [place(column, across, this.engine.columns), place(row, down, this.engine.rows)];
  }

  /** Takes an action, and yields for each step after it; the last one has been counted when this ends. */
  *act([x, y, choice, aim]) {
    const { choices, field, speed, steps, free } = this.task;
    const { engine } = this;
    const box = this.box([x, y]);
    const action = { painted: 0, placed: 0, blown: 0 };
    if (choices[choice] === "blow") {
      const number = engine.fields.findIndex((one) => one.qualified === field);
      [Math.floor(aim / 3) - 1, (aim % 3) - 1].forEach((way, component) => engine.calls.set(number, component, ...box, speed * way));
      action.blown = 1;
    } else if (choices[choice] !== "nothing") {
      const before = engine.ids().slice();
      engine.calls.paint(this.ids.get(choices[choice]), ...box);
      action.painted = engine.ids().reduce((sum, id, at) => sum + Number(id !== before[at]), 0);
      action.placed = 1;
    }
    this.actions.push([x, y, choice, aim]);
    const count = steps + (this.left ? 0 : free);
    for (let i = 0; i < count; i++) {
      engine.step(1);
      yield i;
    }
    Object.assign(action, { taken: this.actions.length, left: this.left });
    const facts = { now: this._measured(), start: this.first, before: this.before, action };
    const { each = 0, final = 0, success = 0, failure = 0 } = this.task.goal;
    this.success = Boolean(value(success, facts));
    this.over = !this.left || this.success || Boolean(value(failure, facts));
    this.total += Math.fround(value(each, facts) + (this.over ? value(final, facts) : 0));
    this.before = facts.now;
  }

  _measured() {
    const ids = this.engine.ids();
    const { rows, columns } = this.engine;
    return this.task.measures.map(({ how, region, let: beside, inside, outside }) => {
      const [within, near] = [this.regions[region], this.regions[beside]];
      const counts = [outside, inside].map((some) => new Set(some));
      let [count, top] = [0, rows];
      for (let i = 0; i < ids.length; i++) {
        if ((within && !within[i]) || !counts[near?.[i] ?? 0].has(ids[i])) continue;
        count++;
        top = Math.min(top, Math.floor(i / columns));
      }
      if (how === "highest") return rows - top;
      return how === "share" ? count / Math.max(1, within ? within.reduce((sum, one) => sum + one, 0) : ids.length) : count;
    });
  }
}

/** Actions in four characters each, for a link. */
export const written = (actions) => actions.map((one) => one.map((number) => CODE[number]).join("")).join("");

/** The actions of a link; those that the task does not have are refused. */
export function read(text, { actions, bins, choices }) {
  const most = [bins[1], bins[0], choices.length, AIMS];
  const found = (text.match(/.{1,4}/g) ?? []).map((four) => [...four].map((one) => CODE.indexOf(one)));
  const isGood = (one) => one.length === 4 && one.every((number, i) => number >= 0 && number < most[i]);
  if (found.length > actions || !found.every(isGood)) throw new Error("The link is damaged: the task has no such actions.");
  return found;
}
