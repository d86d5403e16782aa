// Plays tasks: node judge.mjs JUDGE FOLDER, which holds NAME.json, RULES-SIZE.wasm and actions.json; prints the returns.
import { readFileSync } from "node:fs";
import { join } from "node:path";

const [page, folder] = process.argv.slice(2);
const { Judge, read, written } = await import(page);
const given = JSON.parse(readFileSync(join(folder, "actions.json")));
const modules = {};
const seen = {};
for (const [name, worlds] of Object.entries(given)) {
  const task = JSON.parse(readFileSync(join(folder, `${name}.json`)));
  seen[name] = [];
  for (const [number, actions] of worlds.entries()) {
    const { rules, world } = task.starts[number];
    const file = `${rules}-${world.rows}x${world.columns}.wasm`;
    modules[file] ??= await WebAssembly.compile(readFileSync(join(folder, file)));
    const judge = await Judge.start(task, number, modules[file]);
    for (const one of read(written(actions), judge.task)) if (!judge.over) [...judge.act(one)];
    seen[name].push([judge.total, judge.success, judge.actions.length]);
  }
}
console.log(JSON.stringify(seen));
