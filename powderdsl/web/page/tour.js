// The first visit: three steps over the page, which a button or a key ends for good.

import { $, make } from "./dom.js";
import { rules } from "./rules.js";
import { showPanel } from "./tabs.js";

const STEPS = [
  ["frame", "1. Paint", () => ["Choose an element, and paint it into the world while it runs."]],
  ["editor", "2. Change this line", () => [make("code", {}, line()), " Write another element after the arrow: the world goes on under your rules."]],
  ["share", "3. Share", () => ["A link holds the world and its rules. Whoever opens it goes on from there."]],
];
let at = 0;

/** The line of the rules where the cursor is. */
function line() {
  const { doc, selection } = rules.editor.view.state;
  return doc.lineAt(selection.main.head).text.trim().replace(/^(- )?(do: )?/, "");
}

function show() {
  const [id, title, words] = STEPS[at];
  const isClosed = $("side").classList.contains("closed");
  if (id === "editor") showPanel("rules-panel");
  const next = make("button", { type: "button", class: "primary", onclick: () => (++at < STEPS.length ? show() : end()) }, at + 1 < STEPS.length ? "Next" : "Done");
  const buttons = make("div", { class: "row" }, next, ...(at + 1 < STEPS.length ? [make("button", { type: "button", onclick: end }, "Skip")] : []));
  const hadFocus = $("tour").contains(document.activeElement);
  $("tour").replaceChildren(make("strong", {}, title), make("p", {}, ...words()), buttons);
  $("tour").hidden = false;
  if (hadFocus) next.focus();
  if (STEPS[at - 1]?.[0] === "editor" && !isClosed) $("side").classList.add("closed");
  place();
}

/** Puts the step at what it is about. */
function place() {
  for (const [id] of STEPS) $(id).classList.toggle("pointed", !$("tour").hidden && id === STEPS[at][0]);
  if ($("tour").hidden) return;
  $(STEPS[at][0]).scrollIntoView({ block: "nearest", inline: "nearest" });
  const { left, top, bottom } = $(STEPS[at][0]).getBoundingClientRect();
  const { offsetHeight: height, offsetWidth: width } = $("tour");
  const down = bottom + height + 16 < innerHeight ? bottom + 8 : top > height + 16 ? top - height - 8 : bottom - height - 8;
  $("tour").style.left = `${Math.max(8, Math.min(left + 8, innerWidth - width - 8))}px`;
  $("tour").style.top = `${Math.max(8, Math.min(down, innerHeight - height - 8))}px`;
}

function end() {
  $("tour").hidden = true;
  place();
  localStorage.setItem("toured", "yes");
}

addEventListener("resize", place);
addEventListener("keydown", ({ key, target }) => key === "Escape" && !$("tour").hidden && !target.closest?.("dialog, .menu, #editor") && end());
show();
