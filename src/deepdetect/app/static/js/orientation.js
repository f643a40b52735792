// Dominant orientation of the gradients around keypoints (Lowe, 2004, Section 5), as in
// `deepdetect.detector.points.detection`.
import { SIZE_PER_SIGMA, layersOf } from "./scale_space.js";
import { roundHalfEven } from "./selection.js";

const BINS = 36;
const WINDOW_PER_SIGMA = 1.5;
const RADIUS_PER_WINDOW = 3;
const PEAK_FRACTION = 0.8; // a peak above this share of the highest gives a keypoint of its own
const fround = Math.fround;

// OpenCV's polynomial for the arc tangent, in degrees: exact values could fall into other bins.
const ARC = [0.9997878412794807, -0.3258083974640975, 0.1555786518463281, -0.04432655554792128]
  .map((value) => fround(fround(value) * fround(180 / Math.PI)));
const EPSILON = 2.220446049250313e-16;

/** Returns the direction of (x, y) in degrees from 0 to 360. */
function degrees(y, x) {
  const [across, down] = [Math.abs(x), Math.abs(y)];
  const c = fround(Math.min(across, down) / fround(Math.max(across, down) + fround(EPSILON)));
  const c2 = fround(c * c);
  let angle = fround(fround(fround(fround(ARC[3] * c2 + ARC[2]) * c2 + ARC[1]) * c2 + ARC[0]) * c);
  if (down > across) angle = fround(90 - angle);
  if (x < 0) angle = fround(180 - angle);
  if (y < 0) angle = fround(360 - angle);
  return angle;
}

/**
 * @param {Uint8Array} gray
 * @param {{xy: Float32Array, sizes: Float32Array}} points sizes are those of the levels of points
 * @returns {Float32Array} degrees in [0, 360), from x towards y, which points down
 */
export function dominantAngles(gray, width, height, { xy, sizes }) {
  const angles = new Float32Array(sizes.length);
  for (const { rows, scale, ...layer } of layersOf(gray, width, height, sizes)) {
    for (const row of rows) {
      const [x, y] = [xy[2 * row] / scale, xy[2 * row + 1] / scale].map(roundHalfEven);
      const window = WINDOW_PER_SIGMA * sizes[row] / SIZE_PER_SIGMA / scale;
      angles[row] = highest(votesAround(layer, x, y, window));
    }
  }
  return angles;
}

/** Returns the histogram of gradient directions in a Gaussian window around a pixel. */
export function votesAround({ image, width, height }, x, y, window) {
  const radius = roundHalfEven(RADIUS_PER_WINDOW * window);
  const weights = Array.from({ length: radius + 1 }, (_, k) => Math.exp(-0.5 * (k / window) ** 2));
  const votes = new Float64Array(BINS);
  // The outermost pixels have no gradient.
  for (let v = Math.max(1, y - radius); v <= Math.min(height - 2, y + radius); v++) {
    for (let u = Math.max(1, x - radius); u <= Math.min(width - 2, x + radius); u++) {
      const at = v * width + u;
      const dx = fround(image[at + 1] - image[at - 1]);
      const dy = fround(image[at + width] - image[at - width]);
      const bin = roundHalfEven(fround(degrees(dy, dx) * fround(BINS / 360))) % BINS;
      votes[bin] += weights[Math.abs(v - y)] * weights[Math.abs(u - x)] * Math.sqrt(dx * dx + dy * dy);
    }
  }
  return votes;
}

function smoothed(votes) {
  const at = (bin) => votes[(bin + BINS) % BINS];
  return Float64Array.from(votes, (value, k) =>
    (6 * value + 4 * (at(k - 1) + at(k + 1)) + at(k - 2) + at(k + 2)) / 16);
}

/** Returns the direction of the highest bin of the smoothed histogram. */
function highest(votes) {
  const smooth = smoothed(votes);
  return refined(smooth, smooth.indexOf(Math.max(...smooth)));
}

/** Returns the directions of all peaks that are nearly as high as the highest one. */
export function directions(votes) {
  const smooth = smoothed(votes);
  const least = PEAK_FRACTION * Math.max(...smooth);
  return [...smooth.keys()].filter((k) => smooth[k] >= least && smooth[k] > smooth.at(k - 1)
    && smooth[k] > smooth[(k + 1) % BINS]).map((k) => refined(smooth, k));
}

/** Returns the direction of a bin in degrees, refined by a parabola. */
function refined(smooth, best) {
  const [left, middle, right] = [-1, 0, 1].map((step) => smooth[(best + step + BINS) % BINS]);
  const curvature = left - 2 * middle + right;
  const shift = curvature < 0 ? (left - right) / (2 * curvature) : 0;
  const angle = fround((best + shift) * (360 / BINS));
  if (angle < 0) return fround(angle + 360);
  return angle >= 360 ? 0 : angle;
}
