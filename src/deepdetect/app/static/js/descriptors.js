// Upright RootSIFT descriptors: 16x16 pixels in 4x4 cells of 8 directions (Lowe, 2004;
// Arandjelovic and Zisserman, 2012).

export const LENGTH = 128;
const CELLS = 4;
const DIRECTIONS = 8;
const CELL_PX = 4;
const REACH_PX = 10; // half the window, and half a cell for the interpolation between cells
const BLUR_PX = (1.6 ** 2 - 0.5 ** 2) ** 0.5; // SIFT's first blur, of a picture that has 0.5 already
const MAX_VALUE = 0.2;

/** @param {Uint8Array} gray @param {Float32Array} xy @returns {Float32Array} rows of 128, length 1 */
export function describe(gray, width, height, xy) {
  const image = blur(gray, width, height, BLUR_PX);
  const result = new Float32Array(xy.length / 2 * LENGTH);
  for (let k = 0; k < xy.length / 2; k++) {
    const row = result.subarray(k * LENGTH, (k + 1) * LENGTH);
    addGradients(row, image, width, height, xy[2 * k], xy[2 * k + 1]);
    normalise(row);
  }
  return result;
}

function addGradients(row, image, width, height, x, y) {
  const [column, line] = [Math.round(x), Math.round(y)];
  for (let v = Math.max(1, line - REACH_PX); v <= Math.min(height - 2, line + REACH_PX); v++) {
    for (let u = Math.max(1, column - REACH_PX); u <= Math.min(width - 2, column + REACH_PX); u++) {
      const at = v * width + u;
      const [dx, dy] = [image[at + 1] - image[at - 1], image[at + width] - image[at - width]];
      // Cells are numbered from 0 to 3; a pixel counts for the four nearest to it.
      const [cx, cy] = [(u - x) / CELL_PX + 1.5, (v - y) / CELL_PX + 1.5];
      if (cx <= -1 || cy <= -1 || cx >= CELLS || cy >= CELLS) continue;
      const distance = ((cx - 1.5) ** 2 + (cy - 1.5) ** 2) / (CELLS * CELLS / 2);
      const strength = Math.hypot(dx, dy) * Math.exp(-distance);
      const direction = Math.atan2(dy, dx) / (2 * Math.PI) * DIRECTIONS + DIRECTIONS;
      const [left, top, low] = [Math.floor(cx), Math.floor(cy), Math.floor(direction)];
      for (let j = 0; j < 2; j++) {
        for (let i = 0; i < 2; i++) {
          const [cell, floor] = [left + i, top + j];
          if (cell < 0 || floor < 0 || cell >= CELLS || floor >= CELLS) continue;
          const share = strength * (1 - Math.abs(cx - cell)) * (1 - Math.abs(cy - floor));
          const first = (floor * CELLS + cell) * DIRECTIONS;
          row[first + low % DIRECTIONS] += share * (low + 1 - direction);
          row[first + (low + 1) % DIRECTIONS] += share * (direction - low);
        }
      }
    }
  }
}

function normalise(row) {
  let length = 0;
  for (const value of row) length += value * value;
  const most = MAX_VALUE * Math.sqrt(length);
  let total = 0;
  for (let k = 0; k < LENGTH; k++) total += row[k] = Math.min(row[k], most);
  if (total > 0) for (let k = 0; k < LENGTH; k++) row[k] = Math.sqrt(row[k] / total);
}

/** Gaussian blur; at the border the picture is mirrored. */
export function blur(gray, width, height, sigma) {
  const radius = Math.ceil(3 * sigma);
  const kernel = Float32Array.from({ length: 2 * radius + 1 },
                                   (_, k) => Math.exp(-((k - radius) ** 2) / (2 * sigma ** 2)));
  const total = kernel.reduce((sum, value) => sum + value);
  const mirrored = (k, side) => {
    if (side === 1) return 0;
    while (k < 0 || k >= side) k = k < 0 ? -k : 2 * side - 2 - k;
    return k;
  };
  const pass = (source, step, side, lines, lineStep) => {
    const result = new Float32Array(source.length);
    for (let k = 0; k < side; k++) {
      const taps = Array.from(kernel, (_, j) => mirrored(k + j - radius, side) * step);
      for (let line = 0; line < lines; line++) {
        let sum = 0;
        for (let j = 0; j < taps.length; j++) sum += kernel[j] * source[taps[j] + line * lineStep];
        result[k * step + line * lineStep] = sum / total;
      }
    }
    return result;
  };
  return pass(pass(gray, 1, width, height, width), width, height, width, 1);
}
