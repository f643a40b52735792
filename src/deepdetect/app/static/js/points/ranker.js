// The ranker: a perceptron that orders candidates by how surely they are found again.
import { FEATURES } from "./candidate_features.js";

const MAX_DEVIATIONS = 6;
const LOCAL_HEADER = 0x04034b50;
const CHECKSUM_AT = 14;
const NAME_LENGTH_AT = 26;
const EXTRA_LENGTH_AT = 28;
const HEADER_BYTES = 30;
const CRC_POLYNOMIAL = 0xedb88320;
const fround = Math.fround;

/**
 * @typedef {object} Ranker
 * @property {Float32Array} mean of the features @property {Float32Array} deviation
 * @property {{weight: Float32Array, bias: Float32Array}[]} layers
 */

/** Reads ranker.npz as it is in the package. @param {ArrayBuffer} content @returns {Ranker} */
export function readRanker(content) {
  const arrays = readArrays(content);
  const layers = [0, 1, 2].map((k) => ({ weight: arrays[`weight${k}`], bias: arrays[`bias${k}`] }));
  const { mean, deviation } = arrays;
  const sides = [FEATURES, ...layers.map(({ bias }) => bias?.length)];
  const fits = mean?.length === FEATURES && deviation?.length === FEATURES && sides.at(-1) === 1
    && layers.every(({ weight }, k) => weight?.length === sides[k] * sides[k + 1]);
  if (!fits) throw new Error("it holds no ranker, or another one");
  return { mean, deviation, layers };
}

/** The float32 arrays of an uncompressed npz file, by name. */
function readArrays(content) {
  const view = new DataView(content);
  const arrays = {};
  for (let at = 0; at + HEADER_BYTES < content.byteLength && view.getUint32(at, true) === LOCAL_HEADER;) {
    const [compression, size32] = [view.getUint16(at + 8, true), view.getUint32(at + 18, true)];
    const nameLength = view.getUint16(at + NAME_LENGTH_AT, true);
    const extra = at + HEADER_BYTES + nameLength;
    const start = extra + view.getUint16(at + EXTRA_LENGTH_AT, true);
    // numpy notes sizes in 64 bits, after four bytes of the extra field.
    const size = size32 === 0xffffffff ? Number(view.getBigUint64(extra + 4, true)) : size32;
    if (compression !== 0) throw new Error("it is compressed");
    if (start + size > content.byteLength) throw new Error("it ends early");
    const part = content.slice(start, start + size);
    if (checksum(new Uint8Array(part)) !== view.getUint32(at + CHECKSUM_AT, true)) {
      throw new Error("its checksum is wrong");
    }
    const name = text(content, at + HEADER_BYTES, nameLength).replace(/\.npy$/, "");
    const array = readArray(part);
    if (array) arrays[name] = array;
    at = start + size;
  }
  return arrays;
}

/** CRC-32, as zip files have it. */
function checksum(bytes) {
  let value = ~0;
  for (const byte of bytes) {
    value ^= byte;
    for (let bit = 0; bit < 8; bit++) value = (value >>> 1) ^ (value & 1 ? CRC_POLYNOMIAL : 0);
  }
  return ~value >>> 0;
}

const text = (content, start, length) => String.fromCharCode(...new Uint8Array(content, start, length));

/** The values of an npy file; null where they are not float32. */
function readArray(content) {
  const view = new DataView(content);
  const long = view.getUint8(6) > 1; // the version of the format
  const start = (long ? 12 : 10) + (long ? view.getUint32(8, true) : view.getUint16(8, true));
  const header = text(content, 10, start - 10);
  return /'descr': '<f4', 'fortran_order': False/.test(header) ? new Float32Array(content.slice(start)) : null;
}

/** @param {Ranker} ranker @param {Float32Array} features rows @returns {Float32Array} logits */
export function rank({ mean, deviation, layers }, features) {
  const logits = new Float32Array(features.length / FEATURES);
  const widths = [FEATURES, ...layers.map(({ bias }) => bias.length)];
  const values = widths.map((width) => new Float32Array(width));
  for (let row = 0; row < logits.length; row++) {
    const first = row * FEATURES;
    for (let k = 0; k < FEATURES; k++) {
      const value = fround(fround(features[first + k] - mean[k]) / deviation[k]);
      values[0][k] = Math.max(-MAX_DEVIATIONS, Math.min(MAX_DEVIATIONS, value));
    }
    for (let layer = 0; layer < layers.length; layer++) {
      addUp(layers[layer], values[layer], values[layer + 1]);
      if (layer + 1 < layers.length) clamp(values[layer + 1]);
    }
    logits[row] = features[first] + values[layers.length][0];
  }
  return logits;
}

/** Outputs of a layer, before what is negative is cut off. */
function addUp({ weight, bias }, inputs, outputs) {
  const even = inputs.length - inputs.length % 4;
  for (let j = 0, at = 0; j < outputs.length; j++) {
    let [a, b, c, d] = [bias[j], 0, 0, 0]; // four sums at once: they do not wait for each other
    for (let k = 0; k < even; k += 4, at += 4) {
      a += weight[at] * inputs[k];
      b += weight[at + 1] * inputs[k + 1];
      c += weight[at + 2] * inputs[k + 2];
      d += weight[at + 3] * inputs[k + 3];
    }
    for (let k = even; k < inputs.length; k++) a += weight[at++] * inputs[k];
    outputs[j] = a + b + (c + d);
  }
}

function clamp(values) {
  for (let k = 0; k < values.length; k++) if (values[k] < 0) values[k] = 0;
}
