// The scale space of a picture, level by level, and its candidates for keypoints: maxima of
// |det Hessian|, as `deepdetect.detector.points.hessian_scales` finds them.
import { blur } from "../gaussian.js";
import { roundHalfEven } from "../selection.js";

const FIRST_SIGMA_PX = 1.5;
const RATIO = 1.35;
const LEVELS = 7; // that have candidates
const NMS_RADIUS = 2;
const LEAST_RESPONSE = Math.fround(1e-8);
const MAX_OFFSET_PX = 0.499;
const fround = Math.fround;

/** Of all levels in pixels: one finer and two coarser ones are only compared with. */
export const SIGMAS_PX = Array.from({ length: LEVELS + 3 }, (_, k) => FIRST_SIGMA_PX * RATIO ** (k - 1));

export const hasCandidates = (level) => level >= 1 && level <= LEVELS;

/**
 * @typedef {object} Level
 * @property {number} width @property {number} height
 * @property {number} gray the mean of the picture from 0 to 1, in whole levels
 * @property {Float32Array} smooth the picture from 0 to 1 less that grey, smoothed
 * @property {Float32Array} determinant of the Hessian, times sigma^4
 * @property {Float32Array} trace of the Hessian, times sigma^2
 * @property {Float32Array} gradient its squared magnitude, times sigma^2
 */

/**
 * The levels from fine to coarse. Only the last two are kept: all would take 400 MB.
 *
 * @param {Uint8Array} gray
 * @yields {{level: number, maps: Level, finer: Level | null}}
 */
export function* buildLevels(gray, width, height) {
  const pixels = width * height;
  const mean = roundHalfEven(gray.reduce((sum, value) => sum + value, 0) / pixels);
  const newMaps = () => ({ width, height, gray: mean / 255, ...Object.fromEntries(
    ["smooth", "determinant", "trace", "gradient"].map((name) => [name, new Float32Array(pixels)])) });
  const room = new Float32Array(pixels);
  let [maps, finer, reached] = [newMaps(), null, 0];
  const unit = Float32Array.from(gray, (value) => (value - mean) / 255);
  for (const [level, sigma] of SIGMAS_PX.entries()) {
    // Gaussians add up by their variances: each level smooths the one before.
    blur(finer?.smooth ?? unit, width, height, Math.sqrt(sigma ** 2 - reached ** 2), maps.smooth, room);
    reached = sigma;
    differentiate(maps, sigma);
    yield { level, maps, finer };
    [maps, finer] = [finer ?? newMaps(), maps];
  }
}

/** Central differences, in the order and the precision of the package. */
function differentiate({ smooth, determinant, trace, gradient, width, height }, sigma) {
  const variance = fround(sigma ** 2);
  const [squared, quarter] = [fround(variance * variance), fround(variance * 0.25)];
  for (let row = 0, at = 0; row < height; row++) {
    const up = (row > 0 ? row - 1 : 1) * width;
    const down = (row < height - 1 ? row + 1 : height - 2) * width;
    for (let column = 0; column < width; column++, at++) {
      const left = column > 0 ? column - 1 : 1;
      const right = column < width - 1 ? column + 1 : width - 2;
      const twice = fround(smooth[at] + smooth[at]);
      const [above, below] = [smooth[up + column], smooth[down + column]];
      const [before, after] = [smooth[at - column + left], smooth[at - column + right]];
      const xx = fround(fround(before - twice) + after);
      const yy = fround(fround(above - twice) + below);
      let xy = fround(fround(smooth[down + right] - smooth[down + left])
                      - fround(smooth[up + right] - smooth[up + left]));
      xy = fround(fround(xy * xy) * 0.0625);
      trace[at] = fround(fround(xx + yy) * variance);
      determinant[at] = fround(fround(fround(xx * yy) - xy) * squared);
      const [dx, dy] = [fround(after - before), fround(below - above)];
      gradient[at] = fround(fround(fround(dx * dx) + fround(dy * dy)) * quarter);
    }
  }
}

/** The largest |determinant| in the window around a pixel. */
export function highestNear({ determinant, width, height }, pixel) {
  const row = Math.floor(pixel / width);
  const column = pixel - row * width;
  const [top, bottom] = [Math.max(0, row - NMS_RADIUS), Math.min(height - 1, row + NMS_RADIUS)];
  const [left, right] = [Math.max(0, column - NMS_RADIUS), Math.min(width - 1, column + NMS_RADIUS)];
  let highest = 0;
  for (let y = top; y <= bottom; y++) {
    for (let x = left; x <= right; x++) {
      const value = Math.abs(determinant[y * width + x]);
      if (value > highest) highest = value;
    }
  }
  return highest;
}

/** The pixels of a level that have the largest |determinant| of their window, but none at the border. */
export function findPeaks(maps) {
  const { determinant, width, height } = maps;
  const found = [];
  for (let row = 1; row < height - 1; row++) {
    for (let column = 1, at = row * width + 1; column < width - 1; column++, at++) {
      const own = Math.abs(determinant[at]);
      if (!(own > LEAST_RESPONSE) || Math.abs(determinant[at - 1]) > own
          || Math.abs(determinant[at + 1]) > own || Math.abs(determinant[at - width]) > own
          || Math.abs(determinant[at + width]) > own) continue;
      if (highestNear(maps, at) === own) found.push(at);
    }
  }
  return Uint32Array.from(found);
}

/** The place of a peak, refined by a parabola in x and in y. @returns {[number, number]} */
export function refine({ determinant, width }, pixel) {
  const offset = (step) => {
    const [before, middle, after] = [-step, 0, step].map((move) => Math.abs(determinant[pixel + move]));
    const bend = 2 * middle - before - after;
    const found = bend > 0 ? (after - before) / (2 * bend) : 0;
    return Math.max(-MAX_OFFSET_PX, Math.min(MAX_OFFSET_PX, found));
  };
  const row = Math.floor(pixel / width);
  return [pixel - row * width + offset(1), row + offset(width)];
}
