// Learned descriptors, rotated and matched as in `deepdetect.features.learned`.
import { mutualMatches } from "./matching.js";

export const RATIO = 0.91;
const CONSTANT = 16; // the first numbers do not change if the image is rotated
// The rest are the real and then the imaginary parts of complex numbers, with these frequencies.
const FREQUENCIES = [12, 8, 4].flatMap((count, k) => Array(count).fill(k + 1));
export const LENGTH = CONSTANT + 2 * FREQUENCIES.length;
const UPRIGHT_DEGREES = 15; // the network tolerates rotations up to this
export const TURNED_KEYPOINTS = 512; // the best keypoints of each image give the relative rotation
const HISTOGRAM_DEGREES = 10;
const NEAR_DEGREES = 20; // largest distance from the fullest bin

const wrapped = (degrees) => ((degrees + 180) % 360 + 360) % 360 - 180;

/** Returns descriptors as in a rotated image. @param {(k: number) => number} degreesOf each row */
export function turnDescriptors(descriptors, degreesOf) {
  const result = descriptors.slice();
  for (let row = 0, start = 0; start < result.length; row++, start += LENGTH) {
    const unit = degreesOf(row) * Math.PI / 180;
    FREQUENCIES.forEach((frequency, k) => {
      const [cos, sin] = [Math.cos(frequency * unit), Math.sin(frequency * unit)];
      const at = start + CONSTANT + k;
      const [real, imaginary] = [descriptors[at], descriptors[at + FREQUENCIES.length]];
      result[at] = real * cos - imaginary * sin;
      result[at + FREQUENCIES.length] = real * sin + imaginary * cos;
    });
  }
  return result;
}

/**
 * Matches upright descriptors of two images after undoing their relative rotation.
 *
 * @typedef {{upright: Float32Array, angles: Float32Array}} Described angles of `TURNED_KEYPOINTS`
 * @param {Described} first @param {Described} second @returns {import("./matching.js").Pairs}
 */
export function matchLearned(first, second) {
  const [own0, own1] = [first, second].map(({ upright, angles }) => turnDescriptors(
    upright.subarray(0, LENGTH * TURNED_KEYPOINTS), (k) => -angles[k]));
  const own = mutualMatches(own0, own1, LENGTH);
  const differences = [...own.rows0].flatMap((row, k) => (
    own.ratios[k] < RATIO ? [second.angles[own.rows1[k]] - first.angles[row]] : []));
  const turn = commonTurn(differences);
  const turned = mutualMatches(first.upright, turnDescriptors(second.upright, () => -turn), LENGTH);
  if (Math.abs(wrapped(turn)) < UPRIGHT_DEGREES) return turned;
  // With few matches, the most frequent rotation may be a matter of chance.
  const upright = mutualMatches(first.upright, second.upright, LENGTH);
  const count = ({ ratios }) => ratios.filter((ratio) => ratio < RATIO).length;
  return count(upright) >= count(turned) ? upright : turned;
}

/** Returns the most frequent rotation among differences of angles, or 0 without any. */
function commonTurn(degrees) {
  const bins = new Uint32Array(360 / HISTOGRAM_DEGREES);
  for (const each of degrees) bins[Math.floor((each + 360) % 360 / HISTOGRAM_DEGREES)]++;
  const around = Array.from(bins, (value, k) => value + bins.at(k - 1) + bins[(k + 1) % bins.length]);
  const centre = (around.indexOf(Math.max(...around)) + 0.5) * HISTOGRAM_DEGREES;
  const near = degrees.map((each) => wrapped(each - centre))
    .filter((gap) => Math.abs(gap) < NEAR_DEGREES).sort((a, b) => a - b);
  if (!near.length) return 0;
  return centre + (near[(near.length - 1) >> 1] + near[near.length >> 1]) / 2;
}
