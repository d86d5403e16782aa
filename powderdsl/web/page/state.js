// The state of the page, which its parts share: which rules, which world, which tool.

import { History } from "./engine.js";

export const app = {
  /** @type {any} */ catalog: null,
  /** @type {any} what the site says about the rules */ rules: null,
  /** @type {Engine} */ engine: null,
  /** @type {Painter} */ painter: null,
  /** The color of each element, by id. @type {Map<number, string>} */ colors: null,
  history: new History(),
  /** The world that `reset` returns to. @type {import("./engine.js").Snapshot} */ start: null,
  running: false,
  speed: 60,
  tool: "brush",
  element: "",
  brush: { shape: "disk", size: 5 },
  /** The cell that a tool is held on. @type {number[] | null} */ held: null,
  /** Functions that parts add: called with each new engine, with the sheet of rules that are opened, */
  onEngine: [],
  onRules: [],
  /** with the panel that is shown, and before each frame. */
  onPanel: [],
  onFrame: [],
  /** Shows why a cell changed, once the compiler is there. @type {(cell: number[]) => void} */ explain: null,
  /** What makes a module of some size for rules that were edited; null for the site's own. */ compiled: null,
  /** Whether the next engine takes over the values of parameters. */ keepParameters: false,
  frames: 0,
  /** Earlier moments of this world, from which its steps can be repeated; none from before an edit. */
  /** @type {import("./engine.js").Snapshot[]} */ checkpoints: [],
};
