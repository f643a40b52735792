// Decoding of image files, rotated upright, and reading of their rows.
import { UserError } from "./background.js";
import { MIN_SIDE } from "./pixels.js";

const MAX_FILE_MB = 100;
const MAX_MEGAPIXELS = 100;

/**
 * Decodes a file and passes its size and a reader of its rows to a function.
 *
 * @template Result
 * @param {Blob} file @param {string} name
 * @param {(size: {width: number, height: number},
 *          readRows: (top: number, rows: number) => Uint8ClampedArray) => Result} use rows are RGBA bytes
 * @returns {Promise<Result>}
 */
export async function decode(file, name, use) {
  if (file.size > MAX_FILE_MB * 1e6) {
    throw new UserError(`${name} is over ${MAX_FILE_MB} MB: use a smaller image.`);
  }
  let bitmap;
  try {
    bitmap = await createImageBitmap(file, { imageOrientation: "from-image",
                                             colorSpaceConversion: "none" });
  } catch {
    throw new UserError(`${name} is not an image that this browser can read: use JPEG or PNG.`);
  }
  try {
    const { width, height } = bitmap;
    check(width, height, name);
    return use({ width, height }, (top, rows) => {
      const canvas = new OffscreenCanvas(width, rows); // small: phones limit the size of a canvas
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(bitmap, 0, -top);
      return context.getImageData(0, 0, width, rows).data;
    });
  } finally {
    bitmap.close();
  }
}

function check(width, height, name) {
  if (Math.min(width, height) < MIN_SIDE) {
    throw new UserError(`${name} is ${width}x${height} pixels: both sides must be at least `
                        + `${MIN_SIDE}, use a larger image.`);
  }
  if (width * height > MAX_MEGAPIXELS * 1e6) {
    throw new UserError(`${name} has over ${MAX_MEGAPIXELS} megapixels: use a smaller image.`);
  }
}
