// The front of the worker that compiles: requests with numbers, a time limit, and a fresh worker after a failure.

import { $, say } from "./dom.js";
import { app } from "./state.js";

const LIMIT = 10_000; // ms
/** For the first request to a fresh worker: rules that were good before, but slow machines load the compiler slowly. */
const COLD_LIMIT = 60_000;

export class CompileFailure extends Error {}

class Compiler {
  /** @param {(stage: string) => void} onStage  told about each stage of loading, then `ready` */
  constructor(onStage) {
    this.onStage = onStage;
    this.limit = LIMIT; // of compilations
    [this.ready, this.next] = [false, 1];
    /** @type {Map<number, {resolve: Function, reject: Function, message: object, timer: number | null, limit: number}>} */
    this.open = new Map();
    /** The last files that were sent, so that a fresh worker knows them. */
    this.files = null;
    /** The files of the last check, if they were without mistakes. */
    this.holds = null;
    this.checks = 0;
    this._start();
  }

  _start() {
    // A worker from a blob inherits the content security policy of the page; one from a file would have none.
    // Its policy allows dynamic imports of the site's files only. Until it is ready, it hears nothing.
    const source = `import(${JSON.stringify(new URL("worker.js", import.meta.url).href)});`;
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(url, { type: "module" });
    this.worker.onmessage = ({ data }) => (data.stage ? this._stage(data) : this._answer(data));
    this.worker.onerror = (event) => this._stage({ stage: "failed", error: event.message });
  }

  _stage({ stage, error }) {
    this.onStage(stage, error);
    if (stage === "failed") {
      for (const { reject } of this.open.values()) reject(new CompileFailure(error));
      this.open.clear();
    }
    if (stage !== "ready") return;
    this.ready = true;
    this.warm = false;
    for (const { message } of this.open.values()) this.worker.postMessage(message);
    const [first] = this.open.keys();
    if (first) this._watch(first);
  }

  _answer({ id, result, error, fatal }) {
    const request = this.open.get(id);
    if (!request) return;
    clearTimeout(request.timer);
    this.open.delete(id);
    this.warm = true;
    // Requests are answered in order: the time of the next one begins now.
    const [following] = this.open.keys();
    if (following) this._watch(following);
    if (error === undefined) request.resolve(result);
    else request.reject(new CompileFailure(error));
    if (fatal) this.restart("the compiler failed");
  }

  _watch(id) {
    const request = this.open.get(id);
    clearTimeout(request.timer);
    const limit = this.warm ? request.limit : COLD_LIMIT;
    const reason = `The compiler was stopped after ${limit / 1000} seconds.`;
    request.timer = setTimeout(() => this.restart(reason), limit);
  }

  /** Ends the worker with all that it does, and starts another. */
  restart(reason) {
    this.worker.terminate();
    const waiting = [...this.open.values()];
    this.open.clear();
    this.ready = false;
    for (const { reject, timer } of waiting) {
      clearTimeout(timer);
      reject(new CompileFailure(reason));
    }
    this._start();
    this.holds = this.files?.[0] ?? null;
    if (this.files) this.call("check", ...this.files).catch(() => {});
  }

  /** Calls a function of `powderdsl.web.bridge`; checks pass files on to a fresh worker, too. */
  call(name, ...args) {
    const id = this.next++;
    return new Promise((resolve, reject) => {
      const message = { id, name, args };
      this.open.set(id, { resolve, reject, message, timer: null, limit: LIMITS[name] ?? this.limit });
      if (!this.ready) return;
      this.worker.postMessage(message);
      if (this.open.size === 1) this._watch(id);
    });
  }

  async check(files, off) {
    this.holds = null;
    const mine = ++this.checks;
    const found = await this.call("check", files, off);
    if (found.ok) this.files = [files, off];
    if (found.ok && mine === this.checks) this.holds = files;
    return found;
  }
}

/** Reports that people ask for may take longer than a compilation. */
const LIMITS = { universe: 60_000, invariants: 60_000, tests: 60_000, trace: 60_000 };

/** The compiler of this page: Python begins to load when this module is first imported. */
export const compiler = new Compiler((stage, error) => {
  $("compiler").textContent = `Compiler: ${stage}`;
  $("compiler").className = stage === "failed" ? "bad" : "";
  if (stage === "ready" && !app.compilerReady) {
    app.compilerReady = performance.now();
    if (app.catalog.offline) navigator.serviceWorker?.register("sw.js").catch(() => {}); // private windows may refuse
  }
  if (error) say(error, true);
});
