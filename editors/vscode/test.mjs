// Colors a pack with VS Code's own engine, and starts the bundled client on a stand-in for VS Code: node test.mjs PACK COMMAND
import { spawnSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import Module from "node:module";

const require = createRequire(import.meta.url);
const { loadWASM, OnigScanner, OnigString } = require("vscode-oniguruma");
const { INITIAL, Registry, parseRawGrammar } = require("vscode-textmate");

await loadWASM(readFileSync(require.resolve("vscode-oniguruma/release/onig.wasm")).buffer);
const path = new URL("syntaxes/powderdsl.tmLanguage.json", import.meta.url);
const registry = new Registry({
  onigLib: { createOnigScanner: (patterns) => new OnigScanner(patterns), createOnigString: (text) => new OnigString(text) },
  loadGrammar: () => parseRawGrammar(readFileSync(path, "utf8"), "grammar.json"),
});
const grammar = await registry.loadGrammar("source.powderdsl");
let state = INITIAL;
const scopes = {};
for (const line of readFileSync(process.argv[2], "utf8").split("\n")) {
  const { tokens, ruleStack } = grammar.tokenizeLine(line, state);
  state = ruleStack;
  for (const { startIndex, endIndex, scopes: all } of tokens)
    (scopes[line.slice(startIndex, endIndex).trim()] ??= []).push(all.at(-1));
}

// A stand-in: everything that is asked for exists, and can be called or made.
const anything = () =>
  new Proxy(class {}, {
    get: (target, name) => (name === "prototype" ? target.prototype : name === Symbol.iterator ? undefined : name === "then" ? undefined : anything()),
    apply: () => anything(),
    construct: () => new (class { dispose() {} })(),
  });
const started = [];
const host = new Proxy(
  {
    version: "1.100.0",
    workspace: {
      getConfiguration: () => ({ get: (name) => ({ command: process.argv[3], with: "powderworld" })[name] }),
      textDocuments: [
        { languageId: "yaml", getText: () => "pack: x\n" },
        { languageId: "yaml", getText: () => "on: push\n" },
      ],
      onDidOpenTextDocument: () => ({ dispose() {} }),
    },
    languages: { setTextDocumentLanguage: (document, language) => started.push([document.getText(), language]) },
  },
  { get: (target, name) => target[name] ?? anything() },
);
class Client {
  constructor(...words) {
    started.push(words.slice(2, 4));
  }
  async start() {
    started.push("started");
  }
  async stop() {
    started.push("stopped");
  }
}
const load = Module._load;
Module._load = (name, ...rest) =>
  name === "vscode" ? host : name === "vscode-languageclient/node" ? { LanguageClient: Client } : load(name, ...rest);
const extension = require("./extension.js");
await extension.activate({ subscriptions: [] });
await extension.deactivate();
const bundle = spawnSync("node", ["--check", new URL("dist/extension.js", import.meta.url).pathname]);
console.log(JSON.stringify({ scopes, started, bundle: bundle.status }));
