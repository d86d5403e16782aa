// Copies what the page needs from npm's packages, with their licenses, to powderdsl/web/parts: node parts.mjs
import { cpSync, existsSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";
import { loadPyodide } from "pyodide";

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
  pyodide: `Pyodide ${version}, Copyright Pyodide contributors and Mozilla. Files of its npm package.
Its source is at https://github.com/pyodide/pyodide/tree/${version}, under this license:`,
  python: `Python ${python}, which is a part of Pyodide: its interpreter and most of its standard library,
in part compiled.
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
// Modules that are imported at the start are compiled here, which took the page two seconds, and tools are left out.
const library = join(parts, "pyodide", "python_stdlib.zip");
const pyodide = await loadPyodide();
pyodide.FS.writeFile("/given.zip", readFileSync(library));
pyodide.runPython(`
import importlib._bootstrap_external, re, sys, zipfile
import datetime, difflib, fractions, graphlib, pickle, secrets  # for powderdsl
files = [getattr(module, "__file__", None) or "" for module in list(sys.modules.values())]
imported = {file.rpartition(".zip/")[2] for file in files if ".zip/" in file}
tools = re.compile(r"(_pyrepl|doctest|multiprocessing|pdb|pydoc|unittest|wsgiref|xmlrpc)\\b")
with zipfile.ZipFile("/given.zip") as given, zipfile.ZipFile("/made.zip", "w", compresslevel=9) as made:
    for name in given.namelist():
        data = given.read(name)
        if name in imported:
            code = compile(data, name, "exec", dont_inherit=True, optimize=2)
            name, data = f"{name}c", importlib._bootstrap_external._code_to_timestamp_pyc(code)
        if not tools.match(name):
            made.writestr(zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)
`);
writeFileSync(library, pyodide.FS.readFile("/made.zip"));
writeFileSync(join(parts, "licenses", "README.txt"), `${versions.join("\n")}\n`);
