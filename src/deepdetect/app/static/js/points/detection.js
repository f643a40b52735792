// Choice of points of all scales from the ranking of an image, as by `deepdetect.PointDetector(N)`.
import { spreadByDistance, spreadOverGrid, suppressNeighbors } from "./suppression.js";

const CANDIDATES_PER_KEYPOINT = 6;
const MIN_CANDIDATES = 8192;
const GRID_CELLS = 16;
const DISTANCE_PX = 2;
const DISTANCE_PER_SIGMA = 1;
const SIZE_PER_SIGMA = 2.5;

/**
 * Points in pixels of the ranked image, best first.
 *
 * @typedef {object} Points
 * @property {Float32Array} xy @property {Float32Array} scores @property {Float32Array} sizes diameters
 */

/**
 * @param {import("./ranking.js").Ranking} ranking
 * @param {number} count largest number of points
 * @param {"none" | "grid" | "anms"} spread
 * @returns {Points}
 */
export function choosePoints(ranking, count, spread = "none") {
  const { xy, sigmas } = ranking;
  ranking.radii ??= sigmas.map((sigma) => Math.max(DISTANCE_PX, DISTANCE_PER_SIGMA * sigma));
  const apart = (rows, limit) => suppressNeighbors(xy, ranking, rows, ranking.radii, DISTANCE_PX, limit);
  let rows;
  if (spread === "none") {
    rows = apart(strongest(ranking, count), count);
  } else {
    rows = ranking.apart ??= apart(Uint32Array.from(sigmas.keys()));
    if (count < rows.length) {
      rows = spread === "grid" ? spreadOverGrid(xy, ranking, rows, count, GRID_CELLS)
                               : spreadByDistance(xy, ranking, rows, count);
    }
  }
  return {
    xy: Float32Array.from({ length: 2 * rows.length }, (_, k) => xy[2 * rows[k >> 1] + (k & 1)]),
    scores: Float32Array.from(rows, (row) => scoreOf(ranking.logits[row])),
    sizes: Float32Array.from(rows, (row) => SIZE_PER_SIGMA * sigmas[row]),
  };
}

/** Maps a logit of the ranker to a score in (0, 1), without saturation. */
const scoreOf = (logit) => 0.5 + 0.5 * logit / (1 + Math.abs(logit));

/** Returns how many of the strongest candidates are ranked to get `count` points. */
export const candidatesFor = (count) => Math.max(CANDIDATES_PER_KEYPOINT * count, MIN_CANDIDATES);

function strongest({ strengthRanks }, count) {
  const most = candidatesFor(count);
  const rows = new Uint32Array(Math.min(most, strengthRanks.length));
  for (let row = 0, found = 0; found < rows.length; row++) {
    if (strengthRanks[row] < most) rows[found++] = row;
  }
  return rows;
}
