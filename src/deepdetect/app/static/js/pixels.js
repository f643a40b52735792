// Input of the network: sizes, scaling and conversion of pixels, as in the Python package.
import { roundHalfEven } from "./selection.js";

export const MAX_PIXELS = 2_000_000; // larger images are scaled down to this, as by `detect`
export const MIN_SIDE = 16;
const STRIDE = 8;

/** Layout of pixels: the step from one to the next, and the number of values to scale. */
export const COLOUR = { step: 4, values: 3 };
export const GRAY = { step: 1, values: 1 };

/** Returns the size of the network's input: that of the image, or about two megapixels. */
export function networkSize(width, height) {
  if (width * height <= MAX_PIXELS) return [width, height];
  const scale = (MAX_PIXELS / (height * width)) ** 0.5;
  return [width, height].map(
    (side) => Math.max(STRIDE, roundHalfEven(side * scale / STRIDE) * STRIDE));
}

/** Returns the size at which points are detected, which need not be multiples of 8. */
export function pointsSize(width, height) {
  if (width * height <= MAX_PIXELS) return [width, height];
  const scale = (MAX_PIXELS / (height * width)) ** 0.5;
  return [width, height].map((side) => Math.max(1, roundHalfEven(side * scale)));
}

/** Converts RGBA bytes to RGB planes from 0 to 1, one after the other. */
export function toPlanes(rgba, pixels) {
  const planes = new Float32Array(3 * pixels);
  const unit = Math.fround(1 / 255);
  for (let k = 0; k < pixels; k++) {
    for (let c = 0; c < 3; c++) planes[c * pixels + k] = rgba[4 * k + c] * unit;
  }
  return planes;
}

/** Returns whether all pixels have one colour, so that there is nothing to detect. */
export function isConstant(rgba) {
  for (let k = 4; k < rgba.length; k++) {
    if (k % 4 !== 3 && rgba[k] !== rgba[k % 4]) return false;
  }
  return true;
}

/** Returns 8-bit luma (ITU-R BT.601), with OpenCV's integer arithmetic. */
export function luma(rgba) {
  const gray = new Uint8Array(rgba.length / 4);
  for (let k = 0; k < gray.length; k++) {
    gray[k] = (rgba[4 * k] * 9798 + rgba[4 * k + 1] * 19235 + rgba[4 * k + 2] * 3735 + 16384) >> 15;
  }
  return gray;
}

/** Returns weights of OpenCV's area averaging along one axis: [source, weight] for each target. */
function areaWeights(from, to) {
  const scale = from / to;
  return Array.from({ length: to }, (_, target) => {
    const [start, end] = [target * scale, target * scale + scale];
    const cell = Math.min(scale, from - start);
    const last = Math.min(Math.floor(end), from - 1);
    const first = Math.min(Math.ceil(start), last);
    const weights = [];
    if (first - start > 1e-3) weights.push([first - 1, Math.fround((first - start) / cell)]);
    for (let k = first; k < last; k++) weights.push([k, Math.fround(1 / cell)]);
    if (end - last > 1e-3) {
      weights.push([last, Math.fround(Math.min(Math.min(end - last, 1), cell) / cell)]);
    }
    return weights;
  });
}

/**
 * Scales an image down by area averaging, as `cv2.resize` with INTER_AREA does.
 *
 * @param {(top: number, rows: number) => Uint8ClampedArray} readRows returns bytes of rows
 */
export function reduceByArea(readRows, width, height, newWidth, newHeight,
                             { step, values } = COLOUR) {
  const across = areaWeights(width, newWidth);
  const down = areaWeights(height, newHeight);
  const halved = width === 2 * newWidth && height === 2 * newHeight;
  const round = halved ? Math.round : roundHalfEven; // OpenCV has separate code for half the size
  const result = new Uint8ClampedArray(step * newWidth * newHeight).fill(255);
  const sum = new Float32Array(values * newWidth);
  const line = new Float32Array(values * newWidth);
  const bandRows = Math.max(1, Math.floor(2 ** 20 / width));
  let [band, bandTop, reduced] = [null, 0, -1];
  const reduceRow = (row) => {
    if (row === reduced) return; // a row on a boundary contributes to two targets
    if (band === null || row < bandTop || row >= bandTop + bandRows) {
      bandTop = row - row % bandRows;
      band = readRows(bandTop, Math.min(bandRows, height - bandTop));
    }
    const start = step * (row - bandTop) * width;
    line.fill(0);
    across.forEach((weights, x) => {
      for (const [source, weight] of weights) {
        const at = start + step * source;
        for (let c = 0; c < values; c++) line[values * x + c] += Math.fround(band[at + c] * weight);
      }
    });
    reduced = row;
  };
  down.forEach((weights, y) => {
    sum.fill(0);
    for (const [row, weight] of weights) {
      reduceRow(row);
      for (let k = 0; k < sum.length; k++) sum[k] += Math.fround(line[k] * weight);
    }
    for (let x = 0; x < newWidth; x++) {
      for (let c = 0; c < values; c++) {
        result[step * (y * newWidth + x) + c] = round(sum[values * x + c]);
      }
    }
  });
  return result;
}
