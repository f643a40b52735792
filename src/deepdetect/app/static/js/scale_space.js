// SIFT's Gaussian scale space, as `deepdetect.features.scale_space` builds it: which of its images
// belongs to a keypoint of some size.
import { blur } from "./gaussian.js";
import { roundHalfEven } from "./selection.js";

export const LAYERS = 3; // of an octave that hold keypoints
export const BASE_SIGMA_PX = 1.6;
export const CAMERA_SIGMA_PX = 0.5; // blur that a picture is assumed to have
export const SIZE_PER_SIGMA = 2;
const MIN_SIDE_PX = 8;

/** The layer whose sigma is nearest to that of a keypoint, counted from the first of octave 0. */
function nearestLayer(size, width, height) {
  const step = roundHalfEven(LAYERS * Math.log2(size / SIZE_PER_SIGMA / BASE_SIGMA_PX));
  const lastOctave = Math.max(0, Math.floor(Math.log2(Math.min(width, height) / MIN_SIDE_PX)));
  return Math.max(1, Math.min(LAYERS * (lastOctave + 1), step));
}

/**
 * Goes through the images of the scale space, from fine to coarse, that are nearest to the sizes of keypoints.
 *
 * @param {Uint8Array} gray @param {ArrayLike<number>} sizes diameters in pixels
 * @yields {{image: Float32Array, width: number, height: number, scale: number, rows: number[]}} the
 *   pixel (x, y) is at (x, y) * scale of the picture; rows are those of the keypoints
 */
export function* layersOf(gray, width, height, sizes) {
  const rows = new Map(); // of each layer
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

/** Every second pixel of every second row. */
export function halved(image, width, height) {
  const [newWidth, newHeight] = [width, height].map((side) => Math.ceil(side / 2));
  const result = new Float32Array(newWidth * newHeight);
  for (let y = 0, at = 0; y < newHeight; y++) {
    for (let x = 0; x < newWidth; x++) result[at++] = image[2 * y * width + 2 * x];
  }
  return [result, newWidth, newHeight];
}
