// The panels beside the world with the tabs that show them, and arrow keys in groups of buttons.

import { $ } from "./dom.js";
import { app } from "./state.js";

/** Shows the panel of a tab; on phones, as a sheet. */
export function showPanel(id) {
  $("side").classList.remove("closed");
  for (const tab of document.querySelectorAll("[data-panel]")) {
    const on = tab.dataset.panel === id;
    tab.setAttribute("aria-selected", String(on));
    $(tab.dataset.panel).hidden = !on;
  }
  markStop($("tabs"));
  for (const one of app.onPanel) one(id);
}

/** On phones, the tab of an open sheet closes it. */
export function toggleSheet(id) {
  const isOpen = !$(id).hidden && !$("side").classList.contains("closed");
  showPanel(id);
  $("side").classList.toggle("closed", isOpen);
}

const isOn = (button) => ["aria-checked", "aria-selected"].some((name) => button.getAttribute(name) === "true");

/** The Tab key stops once at a group of radio buttons or tabs: at the chosen one. */
export function markStop(group) {
  const buttons = [...group.querySelectorAll("[role=radio], [role=tab]")];
  const stop = buttons.find(isOn) ?? buttons[0];
  for (const one of buttons) one.tabIndex = one === stop ? 0 : -1;
}

const STEPS = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };

/** Arrow keys, Home and End choose among the buttons of a group. */
export function arrows(group) {
  group.addEventListener("keydown", (event) => {
    const buttons = [...group.querySelectorAll("[role=radio]:not(:disabled), [role=tab]")];
    const at = buttons.indexOf(event.target);
    if (at < 0 || event.ctrlKey || event.altKey || event.metaKey) return;
    let to;
    if (event.key in STEPS) to = (at + STEPS[event.key] + buttons.length) % buttons.length;
    else if (event.key === "Home") to = 0;
    else if (event.key === "End") to = buttons.length - 1;
    else return;
    event.preventDefault();
    event.stopPropagation();
    buttons[to].click();
    buttons[to].focus();
  });
}
