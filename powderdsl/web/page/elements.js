// Elements and their rules: the lines that mention one, and a form that writes the pack of a new one.

import { $, fill, make } from "./dom.js";
import { addFile, goTo, linesOf, rules } from "./rules.js";
import { app } from "./state.js";
import { showPanel } from "./tabs.js";

/** How new elements move, in words, and what says so where the rules have gravity. */
const MOVES = {
  falls: ["falls like sand", "density: 4, gravity: yes, tags: powder"],
  flows: ["flows like water", "density: 3, gravity: yes, tags: fluid"],
  floats: ["floats on water", "density: 2, gravity: yes, tags: powder"],
  rises: ["rises like gas", "density: 0, gravity: yes, tags: fluid"],
  stays: ["stays where it is", "density: 5"],
};

/** The lines about an element: its own, then rules that name it or one of its tags. */
function mentions(qualified) {
  const [pack, name] = qualified.split(".");
  const home = Object.keys(rules.files).find((file) => rules.packs[file] === pack);
  const lines = [...linesOf(rules.files[home] ?? "")].filter(({ section }) => section === "elements");
  const from = lines.findIndex(({ text }) => new RegExp(`^  ${name}:`).test(text));
  const to = lines.findIndex(({ text }, at) => at > from && /^ {0,2}\w/.test(text));
  const own = from < 0 ? [] : lines.slice(from, to < 0 ? undefined : to);
  const tags = /\btags: *(\[[^\]]*\]|\w+)/.exec(own.map(({ text }) => text).join(" "))?.[1].match(/\w+/g) ?? [];
  const word = new RegExp(`(?<![.\\w])(${[name, ...tags].join("|")})(?!\\w)`);
  const found = own.slice(0, 1).map((one) => ({ file: home, ...one }));
  for (const [file, text] of Object.entries(rules.files))
    for (const one of linesOf(text)) if (["passes", "sets", "also"].includes(one.section) && word.test(one.text)) found.push({ file, ...one });
  return found.map((one) => ({ ...one, column: Math.max(one.text.search(word), 0) + 1 }));
}

/** Lists the rules of the chosen element above the editor, and shows the first one. */
function showMentions() {
  const { name, qualified } = app.engine.elements.find((one) => one.qualified === app.element);
  const rows = mentions(qualified).map(({ file, line, column, text }) => {
    const words = [make("small", {}, `${file}:${line}`), " ", make("code", {}, text.trim().replace(/^- /, ""))];
    return make("button", { type: "button", onclick: () => goTo(file, line, column) }, ...words);
  });
  const close = make("button", { type: "button", class: "small", onclick: hide }, "Close");
  const head = make("div", { class: "row" }, make("strong", { class: "grow" }, `Lines about ${name} and its tags`), close);
  $("mentions").replaceChildren(head, ...(rows.length ? rows : [make("p", { class: "soft" }, "No line names it.")]));
  $("mentions").hidden = false;
  showPanel("rules-panel");
  rows[0]?.click();
  rows[0]?.focus();
}

function hide() {
  $("mentions").hidden = true;
  $("rules-of").focus();
}

const form = $("new").querySelector("form");
const hasCore = () => Object.keys(rules.files).some((file) => /^core2?\.yaml$/.test(file));

function askElement() {
  const { elements, ground } = app.engine;
  const names = elements.map((one) => [one.qualified, one.name]);
  const { color, moves, name, other, self, that } = form.elements;
  fill(moves, Object.entries(MOVES).map(([key, [words]]) => [key, words]), "falls");
  moves.closest("label").hidden = !hasCore();
  fill(other, [["", "nothing"], ...names.filter(([one]) => one !== elements.find(({ id }) => id === ground).qualified)], "");
  for (const one of [self, that]) fill(one, [["", "stays as it is"], ...names], "");
  [name.value, color.value] = ["", "#e0559a"];
  name.oninput();
  $("new").showModal();
}

form.elements.name.oninput = ({ target } = { target: form.elements.name }) => {
  const taken = app.engine.elements.some((one) => one.name === target.value) || `${target.value}.yaml` in rules.files;
  target.setCustomValidity(taken ? `There is a ${target.value} already.` : "");
};

/** The pack of a new element. */
function written({ name, color, moves, other, self, that }) {
  const short = (qualified) => qualified.split(".")[1];
  const packs = [other && self, other && that, other].filter(Boolean).map((one) => one.split(".")[0].replace(/^core2$/, "core"));
  const needs = [...new Set([...(hasCore() ? ["core"] : []), ...packs])];
  const lines = [`pack: ${name}`, "about: An element of my own.", ...(needs.length ? [`needs: [${needs.join(", ")}]`] : [])];
  lines.push("elements:", `  ${name}: {${hasCore() ? `${MOVES[moves][1]}, ` : ""}color: "${color.toUpperCase()}"}`);
  const changes = [self && [name, short(self), short(other || name)], that && [short(other || name), short(that), name]];
  const acts = other ? changes.filter(Boolean).map(([from, to, beside]) => `      - ${from} -> ${to} if count(${beside}) > 0 with chance 20%`) : [];
  if (acts.length) lines.push("passes:", `  ${name}:`, "    do:", ...acts);
  return `${lines.join("\n")}\n`;
}

form.addEventListener("submit", ({ submitter }) => {
  if (submitter.value !== "write") return;
  const given = Object.fromEntries(new FormData(form));
  addFile(`${given.name}.yaml`, written(given));
});
$("new-element").onclick = askElement;
$("rules-of").onclick = showMentions;
$("new-element").disabled = $("rules-of").disabled = false;
app.onRules.push(() => ($("mentions").hidden = true));
