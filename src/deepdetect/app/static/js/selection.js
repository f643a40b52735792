// Selection of keypoints from a heat map, bit-equal to `deepdetect.features.selection`.
// Pixels: x right, y down, the centre of the first pixel is (0, 0).

const MAX_COORDINATE_BITS = 12;
const fround = Math.fround;

/**
 * A heat map with what every selection needs, computed once, so that selections take milliseconds.
 *
 * @typedef {object} HeatMap
 * @property {number} width
 * @property {number} height
 * @property {Float32Array} logits scores by which pixels are ranked
 * @property {Float32Array} probability sigmoid of the logits
 * @property {Float32Array} sorted logits in ascending order
 */

/**
 * Choice of keypoints, as the options of `DeepDetect.detect`.
 *
 * @typedef {object} Options
 * @property {number} threshold in [0, 1]
 * @property {number | null} density keypoints per pixel in (0, 1]; replaces the threshold
 */

/** @param {Float32Array} logits @returns {Float32Array} probabilities, computed in float32 */
function sigmoid(logits) {
  const result = new Float32Array(logits.length);
  for (let k = 0; k < logits.length; k++) {
    const decay = fround(Math.exp(-Math.abs(logits[k])));
    result[k] = (logits[k] >= 0 ? 1 : decay) / fround(1 + decay);
  }
  return result;
}

/** Returns the rank of a pixel in an ordered dither, whose first N pixels are spread evenly. */
export function bayerOrder(column, row, width, height) {
  const longest = Math.max(width, height) - 1;
  const bits = Math.min(MAX_COORDINATE_BITS, Math.max(1, 32 - Math.clz32(longest)));
  let order = 0;
  for (let k = 0; k < bits; k++) {
    order = 4 * order + 2 * ((column ^ row) & 1) + (row & 1);
    column >>= 1;
    row >>= 1;
  }
  return order; // not normalised, because only the order matters
}

/** @param {Float32Array} logits @returns {HeatMap} */
export function prepare(logits, width, height) {
  const probability = sigmoid(logits);
  return { width, height, logits, probability, sorted: logits.slice().sort() };
}

/** Returns the number of leading entries for which a test holds, by bisection. */
function leading(length, holds) {
  let [low, high] = [0, length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (holds(middle)) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Rounds as Python does: halves to the even neighbour. */
export function roundHalfEven(value) {
  const below = Math.floor(value);
  const rest = value - below;
  return rest > 0.5 || (rest === 0.5 && below % 2) ? below + 1 : below;
}

/** @param {HeatMap} map @param {Options} options @returns {Uint32Array} pixels in ascending order */
export function select(map, options) {
  if (options.density === null) return above(map.probability, fround(options.threshold));
  return highest(map, roundHalfEven(options.density * map.logits.length));
}

// The loops over all pixels are simple, because they run while a slider moves.

/** Returns the pixels with a probability above a threshold. */
function above(probability, threshold) {
  const found = new Uint32Array(probability.length);
  let count = 0;
  for (let k = 0; k < probability.length; k++) if (probability[k] > threshold) found[count++] = k;
  return found.subarray(0, count);
}

/** Returns the `wanted` pixels of highest rank whose probability is not 0. */
function highest({ logits, probability, sorted, width, height }, wanted) {
  if (wanted === 0) return new Uint32Array(0);
  const last = sorted[logits.length - wanted];
  const better = logits.length - leading(sorted.length, (k) => sorted[k] <= last);
  const found = new Uint32Array(logits.length);
  const tied = [];
  let count = 0;
  for (let k = 0; k < logits.length; k++) {
    if (logits[k] < last || probability[k] === 0) continue;
    if (logits[k] === last) tied.push(k);
    found[count++] = k;
  }
  if (better + tied.length <= wanted) return found.subarray(0, count);
  const bayer = (pixel) => bayerOrder(pixel % width, Math.floor(pixel / width), width, height);
  tied.sort((a, b) => bayer(a) - bayer(b) || a - b);
  const dropped = new Set(tied.slice(wanted - better));
  return found.subarray(0, count).filter((pixel) => !dropped.has(pixel));
}
