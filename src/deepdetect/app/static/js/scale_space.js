// SIFT's Gaussian scale space, as in `deepdetect.features.scale_space`, and the layers of keypoints.
import { blur } from "./gaussian.js";
import { roundHalfEven } from "./selection.js";

export const LAYERS = 3; // layers of an octave that can have keypoints
export const BASE_SIGMA_PX = 1.6;
export const CAMERA_SIGMA_PX = 0.5; // assumed blur of an image
export const SIZE_PER_SIGMA = 2;
const MIN_SIDE_PX = 8;

/** Returns the layer whose sigma is nearest to that of a keypoint, counted from octave 0. */
function nearestLayer(size, width, height) {
  const step = roundHalfEven(LAYERS * Math.log2(size / SIZE_PER_SIGMA / BASE_SIGMA_PX));
  const lastOctave = Math.max(0, Math.floor(Math.log2(Math.min(width, height) / MIN_SIDE_PX)));
  return Math.max(1, Math.min(LAYERS * (lastOctave + 1), step));
}

/**
 * Yields, from fine to coarse, the layers of the scale space that are nearest to the sizes of keypoints.
 *
 * @param {Uint8Array} gray @param {ArrayLike<number>} sizes diameters in pixels
 * @yields {{image: Float32Array, width: number, height: number, scale: number, rows: number[]}} the
 *   pixel (x, y) is at (x, y) * scale in the input; rows are those of its keypoints
 */
export function* layersOf(gray, width, height, sizes) {
  const rows = new Map(); // rows of keypoints by layer
  for (let row = 0; row < sizes.length; row++) {
    const layer = nearestLayer(sizes[row], width, height);
    if (!rows.has(layer)) rows.set(layer, []);
    rows.get(layer).push(row);
  }
  const last = Math.max(...rows.keys());
  let [image, sigma, scale] = [Float32Array.from(gray), CAMERA_SIGMA_PX, 1];
  for (let octave = 0; LAYERS * octave < last; octave++) {
    for (let layer = 0; layer <= LAYERS; layer++) {
      const wanted = BASE_SIGMA_PX * 2 ** (layer / LAYERS);
      if (wanted > sigma) image = blur(image, width, height, Math.sqrt(wanted ** 2 - sigma ** 2));
      sigma = wanted;
      const found = layer > 0 ? rows.get(LAYERS * octave + layer) : undefined;
      if (found) yield { image, width, height, scale, rows: found };
    }
    [image, width, height] = halved(image, width, height);
    [sigma, scale] = [BASE_SIGMA_PX, 2 * scale];
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
