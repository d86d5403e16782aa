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
  /** The world's name in its menu, "" for one from elsewhere, and the seed; both as they are used. */
  named: { world: "", seed: "0" },
  /** Whether the world is other than its start and the rules have made it. */
  painted: false,
  /** The number of what has been opened, */ sitting: 0,
  /** and its name among what the browser keeps. */ work: "",
  /** The swap of the engine that is under way. @type {Promise<any> | null} */ swapping: null,
  /** Whether something has changed that the browser does not keep yet. */ unsaved: false,
  running: false,
  speed: 60,
  tool: "brush",
  element: "",
  brush: { shape: "disk", size: 5 },
  /** The cell that a tool is held on. @type {number[] | null} */ held: null,
  /** Functions that parts add: called with each new engine, with the sheet and the files of rules that are opened, */
  onEngine: [],
  onRules: [],
  /** with the panel that is shown, and before each frame. */
  onPanel: [],
  onFrame: [],
  /** Shows why a cell changed, once the compiler is there. @type {(cell: number[]) => void} */ explain: null,
  /** Whether rules run that the page has compiled, not the site's own. */ compiled: false,
  /** The files that were opened, for the editor, which comes later; null for those of the site. */ opened: null,
  /** Whether the next engine takes over the values of parameters. */ keepParameters: false,
  /** What clicks on the world do while a task is played. @type {{act: Function, mark: Function} | null} */ play: null,
  frames: 0,
  /** Earlier moments of this world, from which its steps can be repeated; none from before an edit. */
  /** @type {import("./engine.js").Snapshot[]} */ checkpoints: [],
};
