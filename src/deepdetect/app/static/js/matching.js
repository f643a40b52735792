// Mutual nearest neighbours of descriptors, with the ratio of the best to the second best distance.

/**
 * @typedef {object} Pairs
 * @property {Uint32Array} rows0 @property {Uint32Array} rows1 of the descriptors
 * @property {Float32Array} ratios in [0, 1]: the lower, the more the match stands out
 */

/** @param {Float32Array} first @param {Float32Array} second rows of a length @returns {Pairs} */
export function mutualMatches(first, second, length) {
  const [count0, count1] = [first.length / length, second.length / length];
  const best0 = new Int32Array(count0).fill(-1);
  const best1 = new Int32Array(count1).fill(-1);
  const top1 = new Float32Array(count1).fill(-Infinity);
  const ratios = new Float32Array(count0).fill(1);
  for (let i = 0; i < count0; i++) {
    let [top, next] = [-Infinity, -Infinity];
    for (let j = 0; j < count1; j++) {
      const likeness = product(first, i * length, second, j * length, length);
      if (likeness > top) {
        next = top;
        top = likeness;
        best0[i] = j;
      } else if (likeness > next) {
        next = likeness;
      }
      if (likeness > top1[j]) {
        top1[j] = likeness;
        best1[j] = i;
      }
    }
    const [near, far] = [Math.max(0, 2 - 2 * top), Math.max(0, 2 - 2 * next)];
    ratios[i] = far > 0 && count1 > 1 ? Math.sqrt(near / far) : 1;
  }
  const rows0 = Array.from(best0.keys()).filter((i) => best0[i] >= 0 && best1[best0[i]] === i);
  return {
    rows0: Uint32Array.from(rows0),
    rows1: Uint32Array.from(rows0, (i) => best0[i]),
    ratios: Float32Array.from(rows0, (i) => ratios[i]),
  };
}

function product(first, i, second, j, length) {
  let [a, b, c, d] = [0, 0, 0, 0]; // four sums at once: they do not wait for each other
  for (let k = 0; k < length; k += 4) {
    a += first[i + k] * second[j + k];
    b += first[i + k + 1] * second[j + k + 1];
    c += first[i + k + 2] * second[j + k + 2];
    d += first[i + k + 3] * second[j + k + 3];
  }
  return a + b + (c + d);
}
