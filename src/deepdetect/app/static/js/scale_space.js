// Gaussian scale spaces: SIFT's constants, and the levels of points, as in `deepdetect.detector.points`.
import { blur } from "./gaussian.js";

export const LAYERS = 3; // layers of an octave that can have keypoints
export const BASE_SIGMA_PX = 1.6;
export const CAMERA_SIGMA_PX = 0.5; // assumed blur of an image
export const SIZE_PER_SIGMA = 2;
const POINT_SIZE_PER_SIGMA = 2.5;
const FACTOR = 1.35; // of the sigmas of successive levels
const SIGMAS_PX = Array.from({ length: 10 }, (_, k) => 1.5 * FACTOR ** (k - 1));

/**
 * Yields, from fine to coarse, the levels of the scale space in which the orientations of points are found:
 * the next coarser ones than their own.
 *
 * @param {Uint8Array} gray @param {ArrayLike<number>} sizes diameters in pixels
 * @yields {{image: Float32Array, width: number, height: number, scale: number, rows: number[]}} the
 *   pixel (x, y) is at (x, y) * scale in the input; rows are those of its points
 */
export function* layersOf(gray, width, height, sizes) {
  const rows = new Map(); // rows of points by level
  for (let row = 0; row < sizes.length; row++) {
    const sigma = sizes[row] / POINT_SIZE_PER_SIGMA;
    const level = Math.round(Math.log(sigma / SIGMAS_PX[0]) / Math.log(FACTOR)) + 1;
    if (!rows.has(level)) rows.set(level, []);
    rows.get(level).push(row);
  }
  const last = Math.max(...rows.keys());
  let [image, reached, scale] = [Float32Array.from(gray), 0, 1];
  for (let level = 0; level <= last; level++) {
    if (SIGMAS_PX[level] >= 6 * scale) {
      [image, width, height] = halved(image, width, height);
      scale *= 2;
    }
    image = blur(image, width, height, Math.sqrt(SIGMAS_PX[level] ** 2 - reached ** 2) / scale);
    reached = SIGMAS_PX[level];
    if (!rows.has(level)) continue;
    const own = { image, width, height, scale, rows: rows.get(level) };
    if (reached >= 4 * scale) {
      [own.image, own.width, own.height] = halved(image, width, height);
      own.scale = 2 * scale;
    }
    yield own;
  }
}

/** Returns every second pixel of every second row. */
export function halved(image, width, height) {
  const [newWidth, newHeight] = [width, height].map((side) => Math.ceil(side / 2));
  const result = new Float32Array(newWidth * newHeight);
  for (let y = 0, at = 0; y < newHeight; y++) {
    for (let x = 0; x < newWidth; x++) result[at++] = image[2 * y * width + 2 * x];
  }
  return [result, newWidth, newHeight];
}
