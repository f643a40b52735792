// Keypoints of a heat map, as `deepdetect.features.selection` selects them, to the last bit.
// Pixels: x right, y down, the centre of the first pixel is (0, 0).

const MAX_COORDINATE_BITS = 12;
const MAX_OFFSET_PX = 0.499; // the nearest pixel of a refined keypoint is the one it was found at
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
 * @property {Uint32Array} maxima pixels that rank highest in the 3x3 window around them, best first
 */

/**
 * Which keypoints are wanted: the options of `DeepDetect.detect(..., mode="dense")`.
 *
 * @typedef {object} Options
 * @property {number} threshold in [0, 1]
 * @property {number | null} density keypoints per pixel in (0, 1]; replaces the threshold
 * @property {number | null} maxKeypoints with it: 3x3 suppression, and positions are refined
 */

/** @param {Float32Array} logits @returns {Float32Array} probabilities, in float32 throughout */
export function sigmoid(logits) {
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
  const maxima = localMaxima(logits, width, height);
  const bayer = (pixel) => bayerOrder(pixel % width, Math.floor(pixel / width), width, height);
  maxima.sort((a, b) => logits[b] - logits[a] || bayer(a) - bayer(b) || a - b);
  return { width, height, logits, probability, sorted: logits.slice().sort(), maxima };
}

/** Of equal neighbours the one that comes first in the order of Bayer ranks higher. */
function localMaxima(logits, width, height) {
  const found = new Uint32Array(logits.length);
  let count = 0;
  for (let row = 0, pixel = 0; row < height; row++) {
    for (let column = 0; column < width; column++, pixel++) {
      if (logits[pixel] > -Infinity && isHighest(logits, width, height, column, row)) {
        found[count++] = pixel;
      }
    }
  }
  return found.slice(0, count);
}

function isHighest(logits, width, height, column, row) {
  const own = logits[row * width + column];
  for (let down = -1; down <= 1; down++) {
    for (let across = -1; across <= 1; across++) {
      const [x, y] = [column + across, row + down];
      if (x < 0 || y < 0 || x >= width || y >= height || (!down && !across)) continue;
      const other = logits[y * width + x];
      if (other > own) return false;
      if (other < own) continue;
      const [first, second] = [bayerOrder(column, row, width, height),
                               bayerOrder(x, y, width, height)];
      const earlier = down < 0 || (down === 0 && across < 0);
      if (earlier ? second <= first : second < first) return false;
    }
  }
  return true;
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
  const { probability, logits, maxima } = map;
  const threshold = options.density === null ? fround(options.threshold) : 0;
  const wanted = options.density === null ? null : roundHalfEven(options.density * logits.length);
  if (options.maxKeypoints !== null) {
    const passing = leading(maxima.length, (k) => probability[maxima[k]] > threshold);
    const count = Math.min(passing, options.maxKeypoints, wanted ?? Infinity);
    return maxima.slice(0, count).sort();
  }
  return wanted === null ? above(probability, threshold) : highest(map, wanted);
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

/**
 * Positions of pixels; with `maxKeypoints` refined to the maximum of a parabola in x and in y.
 *
 * @param {HeatMap} map @param {Uint32Array} pixels @param {Options} options
 * @returns {Float32Array} x0, y0, x1, y1, ...
 */
export function positions(map, pixels, options) {
  const { logits, width, height } = map;
  const xy = new Float32Array(2 * pixels.length);
  for (let k = 0; k < pixels.length; k++) {
    const pixel = pixels[k];
    const row = Math.floor(pixel / width);
    const column = pixel - row * width;
    let [right, down] = [0, 0];
    if (options.maxKeypoints !== null) {
      const middle = logits[pixel];
      if (column > 0 && column < width - 1) {
        right = fround(peakOffset(logits[pixel - 1], middle, logits[pixel + 1]));
      }
      if (row > 0 && row < height - 1) {
        down = fround(peakOffset(logits[pixel - width], middle, logits[pixel + width]));
      }
    }
    xy[2 * k] = column + right;
    xy[2 * k + 1] = row + down;
  }
  return xy;
}

function peakOffset(before, middle, after) {
  const bend = 2 * middle - before - after;
  if (!(middle >= before && middle >= after && bend > 0)) return 0;
  return Math.max(-MAX_OFFSET_PX, Math.min(MAX_OFFSET_PX, (after - before) / (2 * bend)));
}
