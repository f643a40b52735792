// Candidates of an image in the order of the ranker, from which any number of points can be chosen
// in milliseconds.

export const ALL_CANDIDATES = Number.MAX_SAFE_INTEGER;

/**
 * Candidates, best first.
 *
 * @typedef {object} Ranking
 * @property {Float32Array} xy x0, y0, x1, y1, ... sub-pixel, the centre of the first pixel is (0, 0)
 * @property {Float32Array} sigmas scales in pixels
 * @property {Float32Array} logits scores of the ranker
 * @property {Uint32Array} strengthRanks ranks by |det Hessian|
 */

/**
 * @param {{x: Float32Array, y: Float32Array, sigmas: Float32Array, logits: Float32Array}} candidates
 *   strongest first, padded with entries whose logit is -infinity
 * @returns {Ranking}
 */
export function rankingOf({ x, y, sigmas, logits }) {
  const end = logits.indexOf(-Infinity);
  // Among equal logits the stronger candidate comes first, as in the package.
  const order = Uint32Array.from((end < 0 ? logits : logits.subarray(0, end)).keys())
    .sort((a, b) => logits[b] - logits[a] || a - b);
  return {
    xy: Float32Array.from({ length: 2 * order.length }, (_, k) => (k % 2 ? y : x)[order[k >> 1]]),
    sigmas: Float32Array.from(order, (row) => sigmas[row]),
    logits: Float32Array.from(order, (row) => logits[row]),
    strengthRanks: order,
  };
}
