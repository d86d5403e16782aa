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

const seen = (color) => SIGHTS.map((sight) => lab(sight(channels(color).map((c) => linear(c / 255)))));
const distance = (a, b) => Math.min(...a.map((one, i) => Math.hypot(...one.map((v, k) => v - b[i][k]))));

const CANDIDATES = [];
for (const r of [0, 64, 128, 192, 255])
  for (const g of [0, 64, 128, 192, 255])
    for (const b of [0, 64, 128, 192, 255])
      CANDIDATES.push(`#${[r, g, b].map((c) => c.toString(16).padStart(2, "0")).join("")}`);

/**
 * Another color for each element: as near to its own as possible, and as far from those before it as possible.
 * @returns {Map<number, string>} by id
 */
export function blindColors(elements) {
  const found = new Map();
  const used = [];
  const options = CANDIDATES.map((color) => ({ color, look: seen(color) }));
  for (const { id, color } of elements) {
    const own = seen(color);
    const all = [{ color, look: own }, ...options];
    const score = ({ look }) => Math.min(0.16, ...used.map((one) => distance(look, one))) * 6 - distance(look, own);
    const best = all.reduce((a, b) => (score(b) > score(a) ? b : a));
    used.push(best.look);
    found.set(id, best.color);
  }
  return found;
}
