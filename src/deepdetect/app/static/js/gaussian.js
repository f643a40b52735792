// Gaussian blur of float32, bit-equal to cv2.GaussianBlur on processors with fused multiply-add, except
// in up to seven columns at the right of images whose width is not a multiple of 8.

const RADIUS_PER_SIGMA = 4;
const fround = Math.fround;

/** @returns {Float64Array} 2 r + 1 float32 weights whose sum is 1 */
function kernelOf(sigma) {
  const radius = Math.floor(Math.round(2 * RADIUS_PER_SIGMA * sigma + 1) / 2);
  const kernel = Float64Array.from({ length: 2 * radius + 1 },
                                   (_, k) => Math.exp(-((k - radius) ** 2) / (2 * sigma ** 2)));
  const total = kernel.reduce((sum, value) => sum + value);
  return kernel.map((value) => fround(value / total));
}

/** Returns the row or column that `k` means if the image is mirrored at its outermost ones. */
function mirrored(k, side) {
  if (side === 1) return 0;
  while (k < 0 || k >= side) k = k < 0 ? -k : 2 * side - 2 - k;
  return k;
}

/**
 * @param {Float32Array | Uint8Array} image
 * @param {Float32Array} result may be `image` itself
 * @param {Float32Array} room buffer of the same length
 */
export function blur(image, width, height, sigma, result = new Float32Array(image.length),
                     room = new Float32Array(image.length)) {
  const kernel = kernelOf(sigma);
  blurRows(image, width, height, kernel, room);
  blurColumns(room, width, height, kernel, result);
  return result;
}

/** Products are exact in float64, so each sum is rounded once, as in fused multiply-add. */
function blurRows(image, width, height, kernel, result) {
  const [taps, radius] = [kernel.length, kernel.length >> 1];
  const padded = new Float64Array(width + 2 * radius + 3);
  const places = Int32Array.from({ length: 2 * radius },
                                 (_, k) => mirrored(k < radius ? k - radius : width + k - radius, width));
  for (let row = 0; row < height; row++) {
    const start = row * width;
    for (let k = 0; k < width; k++) padded[radius + k] = image[start + k];
    for (let k = 0; k < radius; k++) {
      padded[k] = image[start + places[k]];
      padded[radius + width + k] = image[start + places[radius + k]];
    }
    for (let x = 0; x < width; x += 4) { // four independent sums run in parallel
      let [a, b, c, d] = [0, 0, 0, 0];
      for (let k = 0; k < taps; k++) {
        const weight = kernel[k];
        a = fround(weight * padded[x + k] + a);
        b = fround(weight * padded[x + k + 1] + b);
        c = fround(weight * padded[x + k + 2] + c);
        d = fround(weight * padded[x + k + 3] + d);
      }
      result[start + x] = a;
      if (x + 1 < width) result[start + x + 1] = b;
      if (x + 2 < width) result[start + x + 2] = c;
      if (x + 3 < width) result[start + x + 3] = d;
    }
  }
}

function blurColumns(image, width, height, kernel, result) {
  const radius = kernel.length >> 1;
  const sums = new Float32Array(width);
  for (let row = 0; row < height; row++) {
    for (let x = 0; x < width; x++) sums[x] = kernel[radius] * image[row * width + x];
    for (let k = 1; k <= radius; k++) {
      const weight = kernel[radius + k];
      const above = mirrored(row - k, height) * width;
      const below = mirrored(row + k, height) * width;
      for (let x = 0; x < width; x++) {
        sums[x] = weight * fround(image[below + x] + image[above + x]) + sums[x];
      }
    }
    result.set(sums, row * width);
  }
}
