// Copies what the page needs from npm's packages, with their licenses, to powderdsl/web/parts: node parts.mjs
import { cpSync, existsSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const modules = join(here, "node_modules");
const parts = join(here, "..", "..", "powderdsl", "web", "parts");
const PYODIDE = ["pyodide.mjs", "pyodide.asm.mjs", "pyodide.asm.wasm", "python_stdlib.zip", "pyodide-lock.json"];
const DISTRIBUTED = [
  ...["autocomplete", "commands", "lang-yaml", "language", "lint", "search", "state", "view", "streamparser"].map(
    (name) => `@codemirror/${name}`,
  ),
  ...["common", "highlight", "lr", "yaml"].map((name) => `@lezer/${name}`),
];
const EDITOR = [...DISTRIBUTED, "@marijn/find-cluster-break", "crelt", "style-mod", "w3c-keyname"];

rmSync(parts, { recursive: true, force: true });
mkdirSync(join(parts, "pyodide"), { recursive: true });
mkdirSync(join(parts, "licenses"));
const versions = [];
for (const name of ["pyodide", ...EDITOR]) {
  const folder = join(modules, name);
  const about = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  const flat = name.replace("@", "").replace("/", "-");
  versions.push(`${name} ${about.version}, ${about.license}`);
  const license = ["LICENSE", "LICENSE.md"].map((one) => join(folder, one)).find((one) => existsSync(one));
  if (license) cpSync(license, join(parts, "licenses", `${flat}.txt`));
}

// The packages of Pyodide come without the texts of their licenses.
const { version } = JSON.parse(readFileSync(join(modules, "pyodide", "package.json"), "utf8"));
const { python } = JSON.parse(readFileSync(join(modules, "pyodide", "pyodide-lock.json"), "utf8")).info;
const NOTES = {
  pyodide: `Pyodide ${version}, Copyright Pyodide contributors and Mozilla. Unchanged files of its npm package.
Its source is at https://github.com/pyodide/pyodide/tree/${version}, under this license:`,
  python: `Python ${python}, which is a part of Pyodide: its interpreter and its standard library.
What else it contains is listed, with licenses, at https://docs.python.org/${python.split(".", 2).join(".")}/license.html.`,
};
for (const [name, note] of Object.entries(NOTES)) {
  const license = readFileSync(join(here, "licenses", `${name}.txt`), "utf8");
  writeFileSync(join(parts, "licenses", `${name}.txt`), `${note}\n\n${license}`);
}

// The editor is one file: what of CodeMirror the page imports, by the names of its packages.
const packages = DISTRIBUTED.filter((name) => !/yaml$|streamparser|common|lr$/.test(name) || name === "@codemirror/lang-yaml");
await build({
  stdin: { contents: packages.map((name) => `export * from "${name}";`).join("\n"), resolveDir: here },
  outfile: join(parts, "editor.js"),
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "none", // licenses.txt has them
});

versions.splice(1, 0, `python ${python}, PSF-2.0`);
for (const file of PYODIDE) cpSync(join(modules, "pyodide", file), join(parts, "pyodide", file));
writeFileSync(join(parts, "licenses", "README.txt"), `${versions.join("\n")}\n`);
