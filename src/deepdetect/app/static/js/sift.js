// SIFT (Lowe, 2004), for comparison, with OpenCV's constants and its precise upscaling.
import { blur } from "./gaussian.js";
import { directions, votesAround } from "./orientation.js";
import { BASE_SIGMA_PX, CAMERA_SIGMA_PX, LAYERS, halved } from "./scale_space.js";

export const LENGTH = 128;
export const RATIO = 0.8; // Lowe's limit of the ratio test
const MIN_CONTRAST = 0.04 * 255 / LAYERS;
const MAX_EDGE_RATIO = 10;
const BORDER_PX = 5;
const STEPS = 5; // largest number of refinement steps of an extremum
const WINDOW_PER_SIGMA = 1.5;
const [CELLS, BINS] = [4, 8]; // cells of a descriptor along a side, and bins of a cell
const CELL_PER_SIGMA = 3;
const LARGEST = 0.2; // largest entry of a descriptor, for robustness to non-linear illumination

/**
 * Returns the strongest keypoints with their descriptors, rows of 128 numbers and length 1.
 *
 * @param {Uint8Array} gray @returns {{xy: Float32Array, descriptors: Float32Array}}
 */
export function findSift(gray, width, height, count) {
  const found = [];
  let layer = { ...doubled(gray, width, height), scale: 0.5 };
  let sigma = 2 * CAMERA_SIGMA_PX;
  const octaves = Math.round(Math.log2(2 * Math.min(width, height)) - 2) + 1;
  for (let octave = 0; octave < octaves && Math.min(layer.width, layer.height) > 2 * BORDER_PX; octave++) {
    const images = [];
    for (let k = 0; k < LAYERS + 3; k++) {
      const wanted = BASE_SIGMA_PX * 2 ** (k / LAYERS);
      if (wanted > sigma) {
        layer = { ...layer, image: blur(layer.image, layer.width, layer.height, Math.sqrt(wanted ** 2 - sigma ** 2)) };
      }
      sigma = wanted;
      images.push(layer);
    }
    found.push(...keypointsOf(images));
    const { image, scale, ...size } = images[LAYERS];
    const [half, halfWidth, halfHeight] = halved(image, size.width, size.height);
    layer = { image: half, width: halfWidth, height: halfHeight, scale: 2 * scale };
    sigma = BASE_SIGMA_PX;
  }
  found.sort((a, b) => b.response - a.response).splice(count);
  const descriptors = new Float32Array(LENGTH * found.length);
  found.forEach((keypoint, row) => descriptors.set(describe(keypoint), LENGTH * row));
  return { xy: Float32Array.from(found.flatMap(({ x, y, layer: { scale } }) => [x * scale, y * scale])), descriptors };
}

/** Returns the image at twice the size, where (x, y) is at (2 x, 2 y). */
function doubled(gray, width, height) {
  const image = new Float32Array(4 * width * height);
  for (let y = 0, at = 0; y < 2 * height; y++) {
    const [top, below] = [y >> 1, Math.min((y + 1) >> 1, height - 1)].map((row) => row * width);
    for (let x = 0; x < 2 * width; x++) {
      const [left, right] = [x >> 1, Math.min((x + 1) >> 1, width - 1)];
      image[at++] = (gray[top + left] + gray[top + right] + gray[below + left] + gray[below + right]) / 4;
    }
  }
  return { image, width: 2 * width, height: 2 * height };
}

/** Returns the keypoints of an octave: extrema of differences, one for each dominant direction. */
function keypointsOf(images) {
  const { width, height } = images[0];
  const differences = images.slice(1).map(({ image }, k) => image.map((value, at) => value - images[k].image[at]));
  const around = [-1, 0, 1].flatMap((dy) => [-1, 0, 1].map((dx) => dy * width + dx));
  const found = [];
  for (let k = 1; k <= LAYERS; k++) {
    const [below, middle, above] = differences.slice(k - 1, k + 2);
    for (let y = BORDER_PX; y < height - BORDER_PX; y++) {
      for (let x = BORDER_PX, at = y * width + x; x < width - BORDER_PX; x++, at++) {
        const value = middle[at];
        if (Math.abs(value) <= Math.floor(0.5 * MIN_CONTRAST)) continue;
        const sign = Math.sign(value);
        if (!around.every((step) => sign * value >= sign * middle[at + step]
          && sign * value >= sign * below[at + step] && sign * value >= sign * above[at + step])) continue;
        const place = located(differences, width, height, x, y, k);
        if (!place) continue;
        const layer = images[place.k];
        const sigma = BASE_SIGMA_PX * 2 ** (place.scale / LAYERS);
        const votes = votesAround(layer, Math.round(place.x), Math.round(place.y), WINDOW_PER_SIGMA * sigma);
        for (const angle of directions(votes)) found.push({ ...place, sigma, angle, layer });
      }
    }
  }
  return found;
}

/** Refines the position of an extremum; returns null if it is weak or on an edge. */
function located(differences, width, height, x, y, k) {
  for (let step = 0; step < STEPS; step++) {
    const at = y * width + x;
    const [d0, d, d2] = differences.slice(k - 1, k + 2);
    const [gx, gy, gs] = [(d[at + 1] - d[at - 1]) / 2, (d[at + width] - d[at - width]) / 2, (d2[at] - d0[at]) / 2];
    const xx = d[at + 1] + d[at - 1] - 2 * d[at];
    const yy = d[at + width] + d[at - width] - 2 * d[at];
    const ss = d2[at] + d0[at] - 2 * d[at];
    const xy = (d[at + width + 1] - d[at + width - 1] - d[at - width + 1] + d[at - width - 1]) / 4;
    const xs = (d2[at + 1] - d2[at - 1] - d0[at + 1] + d0[at - 1]) / 4;
    const ys = (d2[at + width] - d2[at - width] - d0[at + width] + d0[at - width]) / 4;
    // The inverse of the symmetric matrix, by its cofactors.
    const [a, b, c] = [yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy];
    const whole = xx * a + xy * b + xs * c;
    const [e, f, g] = [xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy];
    const [dx, dy, ds] = [a * gx + b * gy + c * gs, b * gx + e * gy + f * gs, c * gx + f * gy + g * gs]
      .map((value) => -value / whole);
    if (!(Math.max(Math.abs(dx), Math.abs(dy), Math.abs(ds)) < 1e6)) return null;
    if (Math.max(Math.abs(dx), Math.abs(dy), Math.abs(ds)) < 0.5) {
      const response = Math.abs(d[at] + 0.5 * (gx * dx + gy * dy + gs * ds));
      const edge = (xx + yy) ** 2 * MAX_EDGE_RATIO < (MAX_EDGE_RATIO + 1) ** 2 * g;
      return response >= MIN_CONTRAST && g > 0 && edge ? { x: x + dx, y: y + dy, k, scale: k + ds, response } : null;
    }
    [x, y, k] = [x + Math.round(dx), y + Math.round(dy), k + Math.round(ds)];
    if (k < 1 || k > LAYERS || x < BORDER_PX || y < BORDER_PX || x >= width - BORDER_PX || y >= height - BORDER_PX) return null;
  }
  return null;
}

/** Returns histograms of gradients in 4x4 cells around a keypoint, rotated by its angle. */
function describe({ x, y, sigma, angle, layer: { image, width, height } }) {
  const [column, row] = [Math.round(x), Math.round(y)];
  const cell = CELL_PER_SIGMA * sigma;
  const radius = Math.min(Math.round(cell * Math.SQRT2 * (CELLS + 1) / 2), Math.floor(Math.hypot(width, height)));
  const [cos, sin] = [Math.cos(angle * Math.PI / 180) / cell, Math.sin(angle * Math.PI / 180) / cell];
  const side = CELLS + 2; // an extra cell at each side receives votes beyond the border
  const votes = new Float64Array(side * side * BINS);
  for (let v = Math.max(1, row - radius); v <= Math.min(height - 2, row + radius); v++) {
    for (let u = Math.max(1, column - radius); u <= Math.min(width - 2, column + radius); u++) {
      const [right, down] = [(u - column) * cos + (v - row) * sin, (v - row) * cos - (u - column) * sin];
      const [i, j] = [down + CELLS / 2 - 0.5, right + CELLS / 2 - 0.5];
      if (i <= -1 || j <= -1 || i >= CELLS || j >= CELLS) continue;
      const at = v * width + u;
      const [dx, dy] = [image[at + 1] - image[at - 1], image[at + width] - image[at - width]];
      const turn = (Math.atan2(dy, dx) * 180 / Math.PI - angle + 720) % 360 * BINS / 360;
      const weight = Math.hypot(dx, dy) * Math.exp(-(right * right + down * down) / (CELLS * CELLS / 2));
      const [i0, j0, t0] = [i, j, turn].map(Math.floor);
      for (let corner = 0; corner < 8; corner++) {
        const [di, dj, dt] = [corner >> 2, corner >> 1 & 1, corner & 1];
        const share = (di ? i - i0 : 1 - i + i0) * (dj ? j - j0 : 1 - j + j0) * (dt ? turn - t0 : 1 - turn + t0);
        votes[((i0 + di + 1) * side + j0 + dj + 1) * BINS + (t0 + dt) % BINS] += weight * share;
      }
    }
  }
  const result = new Float64Array(LENGTH);
  for (let i = 0; i < CELLS; i++) {
    const start = ((i + 1) * side + 1) * BINS;
    result.set(votes.subarray(start, start + CELLS * BINS), i * CELLS * BINS);
  }
  const largest = LARGEST * Math.hypot(...result);
  const limited = result.map((value) => Math.min(value, largest));
  const length = Math.max(Math.hypot(...limited), 1e-12);
  return limited.map((value) => value / length);
}
