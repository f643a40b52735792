// Worker that matches described keypoints of two images.
import { answer } from "./background.js";
import { estimateGeometry, project } from "./geometry.js";
import { matchLearned } from "./learned.js";
import { mutualMatches } from "./matching.js";
import { LENGTH, RATIO, findSift } from "./sift.js";

const take = (xy, rows) => Float32Array.from({ length: 2 * rows.length },
                                             (_, k) => xy[2 * rows[k >> 1] + (k & 1)]);

answer({
  /** @returns positions of mutual nearest neighbours, with their ratios */
  match({ pictures }) {
    const { rows0, rows1, ratios } = matchLearned(...pictures);
    return { points0: take(pictures[0].xy, rows0), points1: take(pictures[1].xy, rows1), ratios };
  },

  /** @returns {{matches: number, agreeing: number}} for SIFT, with at most `count` keypoints per image */
  sift({ pictures, count }) {
    const [first, second] = pictures.map(({ gray, width, height }) => findSift(gray, width, height, count));
    const { rows0, rows1, ratios } = mutualMatches(first.descriptors, second.descriptors, LENGTH);
    const good = [...ratios.keys()].filter((k) => ratios[k] < RATIO);
    const points = [[first, rows0], [second, rows1]].map(([{ xy }, rows]) => take(xy, good.map((k) => rows[k])));
    const { inliers } = estimateGeometry(...points, pictures.map(({ width, height }) => [width, height]));
    return { matches: good.length, agreeing: inliers.reduce((total, value) => total + value, 0) };
  },

  geometry({ points0, points1, sizes }) {
    return estimateGeometry(points0, points1, sizes);
  },

  /** Warps the second image into the frame of the first; pixels without image are transparent. */
  warp({ rgba, size, matrix, target }) {
    const result = new Uint8ClampedArray(4 * target.width * target.height);
    for (let y = 0, at = 0; y < target.height; y++) {
      for (let x = 0; x < target.width; x++, at += 4) {
        const [u, v] = project(matrix, x, y);
        if (!(u >= 0 && v >= 0 && u <= size.width - 1 && v <= size.height - 1)) continue;
        const [left, top] = [Math.min(Math.floor(u), size.width - 2),
                             Math.min(Math.floor(v), size.height - 2)];
        const [a, b] = [u - left, v - top];
        const first = 4 * (top * size.width + left);
        const below = first + 4 * size.width;
        for (let c = 0; c < 3; c++) {
          result[at + c] = (1 - b) * ((1 - a) * rgba[first + c] + a * rgba[first + 4 + c])
            + b * ((1 - a) * rgba[below + c] + a * rgba[below + 4 + c]);
        }
        result[at + 3] = 255;
      }
    }
    return result;
  },
}, (reason) => `The images could not be matched (${reason}).`);
