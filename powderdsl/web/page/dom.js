// Small helpers for the page's document, which every part of it uses.

export const $ = (id) => document.getElementById(id);

/** An element with attributes and children; text stays text. */
export function make(name, attributes = {}, ...children) {
  const found = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) found.addEventListener(key.slice(2), value);
    else if (value === true) found.setAttribute(key, "");
    else if (value !== false && value !== undefined) found.setAttribute(key, value);
  }
  found.append(...children);
  return found;
}

/** Puts options into a select. @param {string[][]} rows  values and labels */
export function fill(select, rows, chosen) {
  select.replaceChildren(...rows.map(([value, label]) => make("option", { value }, label)));
  select.value = chosen;
}

export function say(text, bad = false) {
  $("status").textContent = text;
  $("status").className = bad ? "bad" : "";
}

export async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${await answer.text()}`);
  return answer;
}

export function failed(error) {
  console.error(error);
  say(String(error.message ?? error), true);
}
