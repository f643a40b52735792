// Mutual nearest neighbours of descriptors, with the ratio of the best to the second-best distance.

/**
 * @typedef {object} Pairs
 * @property {Uint32Array} rows0 @property {Uint32Array} rows1 rows of the descriptors
 * @property {Float32Array} ratios in [0, 1]: lower is more distinctive
 */

/** @param {Float32Array} first @param {Float32Array} second rows of this length @returns {Pairs} */
export function mutualMatches(first, second, length) {
  const [count0, count1] = [first.length / length, second.length / length];
  const best0 = new Int32Array(count0).fill(-1);
  const best1 = new Int32Array(count1).fill(-1);
  const top1 = new Float64Array(count1).fill(-Infinity);
  const ratios = new Float32Array(count0).fill(1);
  const rows = [first, second].map((values) => Float64Array.from(values)); // converted once
  const likeness = new Float64Array(2 * count1);
  for (let i = 0; i < count0; i++) {
    if (i % 2 === 0) multiplyTwo(rows, i, Math.min(i + 1, count0 - 1), length, likeness);
    const start = i % 2 * count1;
    let [top, next] = [-Infinity, -Infinity];
    for (let j = 0; j < count1; j++) {
      const value = likeness[start + j];
      if (value > top) {
        next = top;
        top = value;
        best0[i] = j;
      } else if (value > next) {
        next = value;
      }
      if (value > top1[j]) {
        top1[j] = value;
        best1[j] = i;
      }
    }
    const [near, far] = [Math.max(0, 2 - 2 * top), Math.max(0, 2 - 2 * next)];
    ratios[i] = far > 0 && count1 > 1 ? Math.sqrt(near / far) : 1;
  }
  const kept = Array.from(best0.keys()).filter((i) => best0[i] >= 0 && best1[best0[i]] === i);
  return {
    rows0: Uint32Array.from(kept),
    rows1: Uint32Array.from(kept, (i) => best0[i]),
    ratios: Float32Array.from(kept, (i) => ratios[i]),
  };
}

/** Computes dot products of two rows with all others, four at a time, to reuse loaded values. */
function multiplyTwo([first, second], i, next, length, result) {
  const count = result.length / 2;
  const [a, b] = [i * length, next * length];
  for (let j = 0; j < count; j += 4) {
    const j1 = Math.min(j + 1, count - 1), j2 = Math.min(j + 2, count - 1), j3 = Math.min(j + 3, count - 1);
    const c = j * length, d = j1 * length, e = j2 * length, f = j3 * length;
    let ac = 0, ad = 0, ae = 0, af = 0; // single variables, because lists would be allocated each time
    let bc = 0, bd = 0, be = 0, bf = 0;
    for (let k = 0; k < length; k++) {
      const x = first[a + k], y = first[b + k];
      const u = second[c + k], v = second[d + k], w = second[e + k], z = second[f + k];
      ac += x * u;
      ad += x * v;
      ae += x * w;
      af += x * z;
      bc += y * u;
      bd += y * v;
      be += y * w;
      bf += y * z;
    }
    result[j] = ac;
    result[j1] = ad;
    result[j2] = ae;
    result[j3] = af;
    result[count + j] = bc;
    result[count + j1] = bd;
    result[count + j2] = be;
    result[count + j3] = bf;
  }
}
