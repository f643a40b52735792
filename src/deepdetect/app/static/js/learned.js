// Learned descriptors, turned and matched as `deepdetect.features.learned` does it.
import { mutualMatches } from "./matching.js";

export const RATIO = 0.88;
const CONSTANT = 16; // the first numbers are the same in a picture that is turned
// The others are the real and then the imaginary parts of complex numbers, which turn as often.
const FREQUENCIES = [12, 8, 4].flatMap((count, k) => Array(count).fill(k + 1));
export const LENGTH = CONSTANT + 2 * FREQUENCIES.length;
const UPRIGHT_DEGREES = 15; // the network bears turns up to this
export const TURNED_KEYPOINTS = 512; // the best of each picture tell by how much one is turned
const HISTOGRAM_DEGREES = 10;
const NEAR_DEGREES = 20; // of the fullest bin

const wrapped = (degrees) => ((degrees + 180) % 360 + 360) % 360 - 180;

/** Descriptors as in a picture that is turned. @param {(k: number) => number} degreesOf each */
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
 * Matches upright descriptors, of which one picture's are turned back.
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
  // Where few match, it is chance which turn most of them show.
  const upright = mutualMatches(first.upright, second.upright, LENGTH);
  const count = ({ ratios }) => ratios.filter((ratio) => ratio < RATIO).length;
  return count(upright) >= count(turned) ? upright : turned;
}

/** The angle that most differences of angles are near; 0 without any. */
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
