// Greedy suppression of points, as in `deepdetect.features.selection`.

const DISTANCE_STEP_PX = 0.25; // accuracy of the distance of `spreadByDistance`

/**
 * Keeps points, best first, that are not near one already kept.
 *
 * @param {Float32Array} xy x0, y0, x1, y1, ... inside the image
 * @param {{width: number, height: number}} picture
 * @param {Uint32Array} rows rows of the points, best first
 * @param {Float64Array} radii radii of all points: near means closer than the smaller of two radii
 * @param {number} least smallest radius
 * @param {number} limit largest number of points to keep
 * @returns {Uint32Array} rows that are kept
 */
export function suppressNeighbors(xy, { width, height }, rows, radii, least, limit = rows.length) {
  const columns = Math.floor(width / least) + 1;
  const lines = Math.floor(height / least) + 1;
  const heads = new Int32Array(columns * lines).fill(-1); // last kept point of each cell
  const before = new Int32Array(rows.length); // point kept before it in the same cell
  const kept = new Uint32Array(Math.min(rows.length, limit));
  let count = 0;
  const isNear = (x, y, radius, column, line) => {
    const reach = Math.ceil(radius / least);
    const [left, right] = [Math.max(0, column - reach), Math.min(columns - 1, column + reach)];
    const [top, bottom] = [Math.max(0, line - reach), Math.min(lines - 1, line + reach)];
    for (let v = top; v <= bottom; v++) {
      for (let u = left; u <= right; u++) {
        for (let k = heads[v * columns + u]; k >= 0; k = before[k]) {
          const other = kept[k];
          const [across, down] = [xy[2 * other] - x, xy[2 * other + 1] - y];
          const both = Math.min(radius, radii[other]);
          if (across * across + down * down < both * both) return true;
        }
      }
    }
    return false;
  };
  for (let k = 0; k < rows.length && count < kept.length; k++) {
    const row = rows[k];
    const [x, y] = [xy[2 * row], xy[2 * row + 1]];
    const [column, line] = [Math.floor(x / least), Math.floor(y / least)];
    if (isNear(x, y, radii[row], column, line)) continue;
    before[count] = heads[line * columns + column];
    heads[line * columns + column] = count;
    kept[count++] = row;
  }
  return kept.slice(0, count);
}

/**
 * Returns the best points at the largest distance that their number allows: adaptive non-maximal
 * suppression (Brown, Szeliski and Winder, 2005), by bisection of the distance.
 *
 * @param {Uint32Array} rows best first @returns {Uint32Array} rows
 */
export function spreadByDistance(xy, picture, rows, count) {
  if (count >= rows.length) return rows;
  let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const row of rows) {
    [left, right] = [Math.min(left, xy[2 * row]), Math.max(right, xy[2 * row])];
    [top, bottom] = [Math.min(top, xy[2 * row + 1]), Math.max(bottom, xy[2 * row + 1])];
  }
  const radii = new Float64Array(xy.length / 2);
  let [near, far, best] = [0, Math.hypot(right - left, bottom - top) + 1, rows];
  while (far - near > DISTANCE_STEP_PX) {
    const middle = (near + far) / 2;
    const kept = suppressNeighbors(xy, picture, rows, radii.fill(middle), middle, count);
    if (kept.length >= count) [near, best] = [middle, kept];
    else far = middle;
  }
  return best.slice(0, count);
}

/** Chooses the best point of each cell of a grid, then the second best, and so on. */
export function spreadOverGrid(xy, { width, height }, rows, count, gridCells) {
  const side = Math.max(width, height) / gridCells;
  const filled = new Uint32Array((gridCells + 1) ** 2); // number of points seen in each cell
  const turns = [];
  for (const row of rows) {
    const cell = Math.floor(Math.max(xy[2 * row + 1], 0) / side) * (gridCells + 1)
      + Math.floor(Math.max(xy[2 * row], 0) / side);
    (turns[filled[cell]++] ??= []).push(row);
  }
  return Uint32Array.from(turns.flat().slice(0, count)).sort();
}
