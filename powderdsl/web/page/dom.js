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

/** Shows a line of text, and perhaps more nodes, in the status line. @param {...Node} more */
export function say(text, bad = false, ...more) {
  $("status").replaceChildren(text, ...more);
  $("status").className = bad ? "bad" : "";
}

/** A command for the terminal, with a button that copies it. */
export function commandLine(text) {
  const button = make("button", { type: "button", class: "small" }, "Copy");
  button.onclick = async () => {
    try {
      await navigator.clipboard.writeText(text);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(shown); // for the user to copy
    }
  };
  const shown = make("code", {}, text);
  return make("span", { class: "command" }, shown, " ", button);
}

/** A report in lines: prose is wrapped, source lines with carets below them are not. */
export function report(text) {
  const found = make("pre", { class: "report" });
  let group = null;
  for (const line of text.split("\n")) {
    const quotes = /^ *\d* *\|/.test(line);
    if (group?.className !== (quotes ? "quoted" : "prose")) {
      group = make("span", { class: quotes ? "quoted" : "prose" });
      found.append(group);
    }
    group.append(`${line}\n`);
  }
  return found;
}

export async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${await answer.text()}`);
  return answer;
}

/** Shows what went wrong; what the page itself does wrong goes to the console, too. */
export function failed(error) {
  if (["TypeError", "ReferenceError", "RangeError"].includes(error.name)) console.error(error);
  say(String(error.message ?? error), true);
}
