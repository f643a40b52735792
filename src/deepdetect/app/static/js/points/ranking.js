// All candidates of a picture in the order of the ranker, computed once: then points of any number
// are chosen in milliseconds.
import { addLevel, addRanks, describeOwnLevel } from "./candidate_features.js";
import { SIGMAS_PX, buildLevels, findPeaks, hasCandidates, refine } from "./hessian_scales.js";
import { rank } from "./ranker.js";

/**
 * Candidates, best first.
 *
 * @typedef {object} Ranking
 * @property {number} width @property {number} height
 * @property {Float64Array} xy x0, y0, x1, y1, ... sub-pixel, the centre of the first pixel is (0, 0)
 * @property {Float64Array} sigmas of their levels in pixels
 * @property {Float32Array} logits of the ranker
 * @property {Uint32Array} strengthRanks their place in the order of |det Hessian|
 */

/** @param {Uint8Array} gray @param {import("./ranker.js").Ranker} ranker @returns {Ranking} */
export function rankCandidates(gray, width, height, ranker) {
  const [groups, places] = [[], []];
  for (const { level, maps, finer } of buildLevels(gray, width, height)) {
    for (const group of groups) {
      if (level - group.level <= 2) addLevel(group, level - group.level, maps);
    }
    if (!hasCandidates(level)) continue;
    const pixels = findPeaks(maps);
    const group = describeOwnLevel(level, pixels, maps);
    addLevel(group, -1, finer);
    groups.push(group);
    for (const pixel of pixels) places.push(refine(maps, pixel));
  }
  const features = joined(groups.map((group) => group.features));
  const strength = joined(groups.map(({ determinants }) => determinants.map(Math.abs)));
  const levels = groups.flatMap(({ level, pixels }) => Array(pixels.length).fill(level));
  const ranks = ranksOf(strength);
  addRanks(features, ranks, width * height);
  const logits = rank(ranker, features);
  // Of equals the stronger one comes first, as in the package.
  const order = Uint32Array.from(logits.keys()).sort((a, b) => logits[b] - logits[a] || ranks[a] - ranks[b]);
  return {
    width, height,
    xy: Float64Array.from({ length: 2 * order.length }, (_, k) => places[order[k >> 1]][k & 1]),
    sigmas: Float64Array.from(order, (row) => SIGMAS_PX[levels[row]]),
    logits: Float32Array.from(order, (row) => logits[row]),
    strengthRanks: Uint32Array.from(order, (row) => ranks[row]),
  };
}

function joined(parts) {
  const result = new Float32Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    result.set(part, at);
    at += part.length;
  }
  return result;
}

/** The place of each in the order from the strongest to the weakest. */
function ranksOf(strength) {
  const order = Uint32Array.from(strength.keys()).sort((a, b) => strength[b] - strength[a] || a - b);
  const ranks = new Uint32Array(strength.length);
  order.forEach((row, place) => { ranks[row] = place; });
  return ranks;
}
