// RootSIFT descriptors: 4x4 cells of 8 directions (Lowe, 2004; Arandjelovic and Zisserman, 2012).
import { SIZE_PER_SIGMA, layersOf } from "./scale_space.js";

export const LENGTH = 128;
const CELLS = 4;
const DIRECTIONS = 8;
const CELL_PER_SIGMA = 3;
const REACH = (CELLS + 1) / 2; // half the window, and half a cell for the interpolation, in cells
const MAX_VALUE = 0.2;

/**
 * Describes keypoints at their own sizes and angles.
 *
 * @param {{xy: Float32Array, sizes: Float32Array, angles: Float32Array}} keypoints angles in degrees
 * @returns {Float32Array} rows of 128, length 1
 */
export function describeAtOwnSize(gray, width, height, { xy, sizes, angles }) {
  const result = new Float32Array(sizes.length * LENGTH);
  for (const { rows, scale, ...layer } of layersOf(gray, width, height, sizes)) {
    for (const k of rows) {
      const place = { x: xy[2 * k] / scale, y: xy[2 * k + 1] / scale, angle: angles[k] * Math.PI / 180,
                      cell: CELL_PER_SIGMA * sizes[k] / SIZE_PER_SIGMA / scale };
      describeOne(result.subarray(k * LENGTH, (k + 1) * LENGTH), layer, place);
    }
  }
  return result;
}

function describeOne(row, layer, place) {
  addGradients(row, layer, place);
  normalise(row);
}

function addGradients(row, { image, width, height }, { x, y, cell, angle }) {
  const [cos, sin] = [Math.cos(angle) / cell, Math.sin(angle) / cell];
  const turn = angle / (2 * Math.PI) * DIRECTIONS;
  const reach = Math.ceil(REACH * cell * (Math.abs(cos) + Math.abs(sin)) * cell);
  const [column, line] = [Math.round(x), Math.round(y)];
  for (let v = Math.max(1, line - reach); v <= Math.min(height - 2, line + reach); v++) {
    for (let u = Math.max(1, column - reach); u <= Math.min(width - 2, column + reach); u++) {
      const at = v * width + u;
      // Cells are numbered from 0 to 3; a pixel counts for the four nearest to it.
      const cx = (u - x) * cos + (v - y) * sin + 1.5;
      const cy = (v - y) * cos - (u - x) * sin + 1.5;
      if (cx <= -1 || cy <= -1 || cx >= CELLS || cy >= CELLS) continue;
      const [dx, dy] = [image[at + 1] - image[at - 1], image[at + width] - image[at - width]];
      const distance = ((cx - 1.5) ** 2 + (cy - 1.5) ** 2) / (CELLS * CELLS / 2);
      const strength = Math.hypot(dx, dy) * Math.exp(-distance);
      const direction = Math.atan2(dy, dx) / (2 * Math.PI) * DIRECTIONS - turn + 2 * DIRECTIONS;
      const [left, top, low] = [Math.floor(cx), Math.floor(cy), Math.floor(direction)];
      for (let j = 0; j < 2; j++) {
        for (let i = 0; i < 2; i++) {
          const [across, down] = [left + i, top + j];
          if (across < 0 || down < 0 || across >= CELLS || down >= CELLS) continue;
          const share = strength * (1 - Math.abs(cx - across)) * (1 - Math.abs(cy - down));
          const first = (down * CELLS + across) * DIRECTIONS;
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
