// What the ranker knows about a candidate: measurements relative to its own scale and strength, as
// `deepdetect.detector.points.candidate_features` takes them.
import { roundHalfEven } from "../selection.js";
import { SIGMAS_PX, highestNear } from "./hessian_scales.js";

const RING_RADII = [1, 2, 3.5, 6]; // in sigmas
const RING_POINTS = 8;
const RING_FEATURES = 8;
export const FEATURES = 23 + RING_FEATURES * RING_RADII.length;
const [DETERMINANT_FLOOR, GRADIENT_FLOOR, STRENGTH_FLOOR] = [1e-7, 1e-6, 1e-8].map(Math.fround);

const STEPS = [-1, 0, 1, 2]; // to the levels that a candidate's is compared with
const NEIGHBORS = [-1, 1, 2];
const [LIKENESS, SIGN, BEND, SLOPE, LIGHT, HIGHEST, RINGS] = [1, 4, 5, 13, 17, 18, 21]; // the first columns
const [RANK, LEVEL] = [FEATURES - 2, FEATURES - 1];

const ANGLES = Array.from({ length: RING_POINTS }, (_, k) => k * (2 * Math.PI / RING_POINTS));
const [ACROSS, DOWN] = [ANGLES.map(Math.cos), ANGLES.map(Math.sin)];

const logDeterminant = (value) => Math.log(Math.abs(value) + DETERMINANT_FLOOR);
const logGradient = (value) => Math.log(value + GRADIENT_FLOOR) / 2;
const strengthOf = (determinant) => Math.sqrt(Math.abs(determinant) + STRENGTH_FLOOR);

/**
 * Candidates of one level.
 *
 * @typedef {object} Group
 * @property {number} level
 * @property {Uint32Array} pixels
 * @property {Float32Array} determinants of the Hessian, times sigma^4
 * @property {Float32Array} features rows of `FEATURES`, which levels beside it are added to
 */

/** Describes candidates by the maps of their own level. @returns {Group} */
export function describeOwnLevel(level, pixels, maps) {
  const determinants = Float32Array.from(pixels, (pixel) => maps.determinant[pixel]);
  const features = new Float32Array(pixels.length * FEATURES);
  const group = { level, pixels, determinants, features };
  for (let k = 0; k < pixels.length; k++) {
    const first = k * FEATURES;
    features[first] = (logDeterminant(determinants[k]) + 9) / 3;
    features[first + SIGN] = Math.sign(determinants[k]);
    features[first + LIGHT] = 2 * (maps.smooth[pixels[k]] + maps.gray) - 1;
    features[first + LEVEL] = (level - 4) / 3;
    for (let ring = 0; ring < RING_RADII.length; ring++) {
      const reach = RING_RADII[ring] * SIGMAS_PX[level];
      describeRing(maps, pixels[k], reach, features, first + RINGS + RING_FEATURES * ring);
    }
  }
  addLevel(group, 0, maps);
  return group;
}

/** Adds what the level that is coarser by `step` shows at the candidates. */
export function addLevel({ pixels, determinants, features }, step, maps) {
  const [place, neighbor] = [STEPS.indexOf(step), NEIGHBORS.indexOf(step)];
  for (let k = 0; k < pixels.length; k++) {
    const [pixel, first] = [pixels[k], k * FEATURES];
    const own = logDeterminant(determinants[k]);
    const bend = Math.atan(maps.trace[pixel] / strengthOf(determinants[k]) / 2);
    features[first + BEND + 2 * place] = bend;
    features[first + BEND + 2 * place + 1] = Math.abs(bend);
    features[first + SLOPE + place] = (logGradient(maps.gradient[pixel]) - own / 2) / 2;
    if (step === 0) continue;
    const other = logDeterminant(maps.determinant[pixel]);
    features[first + LIKENESS + neighbor] = (other - own) / 2;
    features[first + HIGHEST + neighbor] = (logDeterminant(highestNear(maps, pixel)) - other) / 2;
  }
}

/** Means and extremes on a circle around a candidate. */
function describeRing({ determinant, smooth, gradient, width, height }, pixel, reach, features, at) {
  const row = Math.floor(pixel / width);
  const column = pixel - row * width;
  const own = logDeterminant(determinant[pixel]);
  const strength = strengthOf(determinant[pixel]);
  let [response, mostResponse, leastResponse] = [0, -Infinity, Infinity];
  let [light, mostLight, leastLight] = [0, -Infinity, Infinity];
  let [slope, mostSlope] = [0, -Infinity];
  for (let k = 0; k < RING_POINTS; k++) {
    const x = Math.max(0, Math.min(width - 1, roundHalfEven(column + reach * ACROSS[k])));
    const y = Math.max(0, Math.min(height - 1, roundHalfEven(row + reach * DOWN[k])));
    const place = y * width + x;
    const hereResponse = logDeterminant(determinant[place]) - own;
    const hereLight = (smooth[place] - smooth[pixel]) / strength;
    const hereSlope = logGradient(gradient[place]) - own / 2;
    response += hereResponse;
    mostResponse = Math.max(mostResponse, hereResponse);
    leastResponse = Math.min(leastResponse, hereResponse);
    light += hereLight;
    mostLight = Math.max(mostLight, hereLight);
    leastLight = Math.min(leastLight, hereLight);
    slope += hereSlope;
    mostSlope = Math.max(mostSlope, hereSlope);
  }
  features[at] = response / RING_POINTS / 2;
  features[at + 1] = mostResponse / 2;
  features[at + 2] = leastResponse / 4;
  features[at + 3] = Math.atan(light / RING_POINTS / 2);
  features[at + 4] = Math.atan(mostLight / 2);
  features[at + 5] = Math.atan(leastLight / 2);
  features[at + 6] = slope / RING_POINTS / 2;
  features[at + 7] = mostSlope / 2;
}

/** Adds the place of each candidate in the order of all by strength. */
export function addRanks(features, ranks, pixels) {
  for (let k = 0; k < ranks.length; k++) {
    features[k * FEATURES + RANK] = Math.log((ranks[k] + 1) / pixels) / 2 + 3;
  }
}
