// Colors that people with color-vision deficiencies can tell apart.

import { channels } from "./view.js";

const linear = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);

/** What a linear color is to somebody without red or green cones (Viénot, Brettel and Mollon 1999). */
const SIGHTS = [
  ([r, g, b]) => [0.10889 * r + 0.89111 * g, 0.10889 * r + 0.89111 * g, 0.00447 * (r - g) + b],
  ([r, g, b]) => [0.29275 * r + 0.70725 * g, 0.29275 * r + 0.70725 * g, -0.02234 * (r - g) + b],
];

/** A linear color in OKLab, where distances are differences that people see. */
function lab([r, g, b]) {
  const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
  const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
  const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  return [
    0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s,
    1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
    0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s,
  ];
}

const far = (a, b) => Math.hypot(...a.map((value, i) => value - b[i]));

/** A color as people see it: with all cones, then without some. */
function looks(color) {
  const light = channels(color).map((c) => linear(c / 255));
  return { color, whole: lab(light), partial: SIGHTS.map((sight) => lab(sight(light))) };
}
const apart = (a, b) => Math.min(...a.partial.map((one, i) => far(one, b.partial[i])));

const ENOUGH = 0.1;
const LEVELS = [0, 51, 102, 153, 204, 255];
const CANDIDATES = [];
for (const r of LEVELS)
  for (const g of LEVELS)
    for (const b of LEVELS)
      CANDIDATES.push(`#${[r, g, b].map((c) => c.toString(16).padStart(2, "0")).join("")}`);

/**
 * Another color for each element: as near to its own as possible, and as far from those before it as possible.
 * @returns {Map<number, string>} by id
 */
export function blindColors(elements) {
  const found = new Map();
  const used = [];
  const options = CANDIDATES.map(looks);
  for (const { id, color } of elements) {
    const own = looks(color);
    // A difference of ENOUGH is seen at once; more of it is worth no change of the color.
    const score = (one) => 5 * Math.min(ENOUGH, ...used.map((other) => apart(one, other))) - far(one.whole, own.whole);
    const best = [own, ...options].reduce((a, b) => (score(b) > score(a) ? b : a));
    used.push(best);
    found.set(id, best.color);
  }
  return found;
}

const NIGHT = "#14161B";
const SEEN = 0.25; // the least difference from the ground

/**
 * Colors for a dark ground: those that would vanish on it become lighter.
 * @returns {Map<number, string>} by id, of those that change
 */
export function darkColors(elements, ground) {
  const night = looks(NIGHT);
  const found = new Map([[ground, NIGHT]]);
  for (const { id, color } of elements) {
    let lighter = color;
    for (let i = 0; i < 20 && far(looks(lighter).whole, night.whole) < SEEN; i++)
      lighter = `#${channels(lighter).map((c) => Math.min(255, c + 8).toString(16).padStart(2, "0")).join("")}`;
    if (id !== ground && lighter !== color) found.set(id, lighter);
  }
  return found;
}
