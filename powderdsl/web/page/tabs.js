// The panels beside the world, and the tabs that show them.

import { $ } from "./dom.js";
import { app } from "./state.js";

export function showPanel(id) {
  for (const tab of document.querySelectorAll("[data-panel]")) {
    const on = tab.dataset.panel === id;
    tab.setAttribute("aria-selected", String(on));
    $(tab.dataset.panel).hidden = !on;
  }
  for (const one of app.onPanel) one(id);
}
