// Keypoints of a heat map, as `deepdetect.features.selection` selects them, to the last bit.
// Pixels: x right, y down, the centre of the first pixel is (0, 0).

const MAX_COORDINATE_BITS = 12;
const fround = Math.fround;

/**
 * What every selection needs of a map, computed once: then a selection takes milliseconds.
 *
 * @typedef {object} HeatMap
 * @property {number} width
 * @property {number} height
 * @property {Float32Array} logits by which pixels are ranked
 * @property {Float32Array} probability their sigmoid
 * @property {Float32Array} sorted the logits in rising order
 */

/**
 * Which keypoints are wanted: the options of `DeepDetect.detect`.
 *
 * @typedef {object} Options
 * @property {number} threshold in [0, 1]
 * @property {number | null} density keypoints per pixel in (0, 1]; replaces the threshold
 */

/** @param {Float32Array} logits @returns {Float32Array} probabilities, in float32 throughout */
function sigmoid(logits) {
  const result = new Float32Array(logits.length);
  for (let k = 0; k < logits.length; k++) {
    const decay = fround(Math.exp(-Math.abs(logits[k])));
    result[k] = (logits[k] >= 0 ? 1 : decay) / fround(1 + decay);
  }
  return result;
}

/** Ranks a pixel as an ordered dither does: the first N are spread evenly, for any N. */
export function bayerOrder(column, row, width, height) {
  const longest = Math.max(width, height) - 1;
  const bits = Math.min(MAX_COORDINATE_BITS, Math.max(1, 32 - Math.clz32(longest)));
  let order = 0;
  for (let k = 0; k < bits; k++) {
    order = 4 * order + 2 * ((column ^ row) & 1) + (row & 1);
    column >>= 1;
    row >>= 1;
  }
  return order; // whole numbers: no division is needed to compare them
}

/** @param {Float32Array} logits @returns {HeatMap} */
export function prepare(logits, width, height) {
  const probability = sigmoid(logits);
  return { width, height, logits, probability, sorted: logits.slice().sort() };
}

/** The number of leading entries for which a test holds that holds for no later one. */
function leading(length, holds) {
  let [low, high] = [0, length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (holds(middle)) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Python's `round`: halves to the even neighbour. */
export function roundHalfEven(value) {
  const below = Math.floor(value);
  const rest = value - below;
  return rest > 0.5 || (rest === 0.5 && below % 2) ? below + 1 : below;
}

/** @param {HeatMap} map @param {Options} options @returns {Uint32Array} pixels, in their order */
export function select(map, options) {
  if (options.density === null) return above(map.probability, fround(options.threshold));
  return highest(map, roundHalfEven(options.density * map.logits.length));
}

// The loops over all pixels are plain: they run while a slider moves.

/** The pixels with a probability above a threshold. */
function above(probability, threshold) {
  const found = new Uint32Array(probability.length);
  let count = 0;
  for (let k = 0; k < probability.length; k++) if (probability[k] > threshold) found[count++] = k;
  return found.subarray(0, count);
}

/** The `wanted` pixels of highest rank, among those that are possible at all. */
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
