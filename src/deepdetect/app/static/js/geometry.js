// Geometry of matches by RANSAC: a homography, or a fundamental matrix if they show depth. Whether it
// can be trusted is decided a contrario (Moisan and Stival, 2004), and which of both it is, as in
// `deepdetect.geometry.two_view`.

const MAX_ERROR_PX = 3;
const ROUNDS = 3000;
const LOCAL_REACHES = [3, 3, 3, 2, 2, 2, 1]; // in units of the largest error (LO-RANSAC: Chum et al., 2003)
const MAX_LOG10_NFA = -6;
// Matches along one edge are not independent evidence, so inliers must lie in separate places.
const MIN_PLACES = 9; // as in Brown and Lowe, 2007: more than 8 inliers
const PLACE_WIDTH = 0.02; // share of the diagonal; so 7 to 9 wrong matches along edges count as 4 or 5
const EPIPOLES = 1000; // number of samples, each of two matches off the plane
const MAX_EPIPOLE_DISTANCE_PX = 1.5; // largest distance of a match from its line through the epipole
const MIN_FRACTION_OF_PLANE = 0.2; // inliers of an epipole per match on the plane
const MIN_FRACTION_OF_REST = 0.5; // inliers of an epipole per match off the plane

const MODELS = {
  homography: { sample: 4, fit: fitHomography, error: transferError },
  fundamental: { sample: 8, fit: fitFundamental, error: epipolarError },
};

/**
 * @typedef {object} Geometry
 * @property {"homography" | "fundamental" | "none"} model
 * @property {number[] | null} matrix 3x3, row by row, from the first image to the second
 * @property {Uint8Array} inliers 1 for each match that agrees with it
 */

/**
 * @param {Float32Array} points0
 * @param {Float32Array} points1
 * @param {[number, number][]} sizes width and height of both images
 * @returns {Geometry}
 */
export function estimateGeometry(points0, points1, sizes) {
  const isTrusted = ({ model, inliers }) => log10NfaOf(model, inliers, sizes[1]) < MAX_LOG10_NFA
    && countPlaces(points0, points1, inliers, sizes) >= MIN_PLACES;
  const plane = ransac("homography", points0, points1);
  const isPlanar = isTrusted(plane);
  if (isPlanar && !showsDepth(points0, points1, plane.matrix)) return plane;
  const epipolar = ransac("fundamental", points0, points1);
  if (isTrusted(epipolar)) return epipolar;
  return isPlanar ? plane : { model: "none", matrix: null, inliers: new Uint8Array(points0.length / 2) };
}

/**
 * Returns whether many matches lie off a plane, and most of these move along lines through one
 * epipole (Chum, Werner and Matas, 2005).
 */
function showsDepth(points0, points1, homography) {
  const count = points0.length / 2;
  const [across, down] = [0, 1].map((axis) => points1.filter((_, k) => k % 2 === axis));
  const [left, top] = [across, down].map((values) => values.reduce((a, b) => Math.min(a, b)));
  const [width, height] = [[across, left], [down, top]].map(
    ([values, least]) => values.reduce((a, b) => Math.max(a, b)) - least);
  const scale = Math.max(width, height);
  const off = []; // projections of points off the plane, and the lines to their true positions
  for (let k = 0; k < count; k++) {
    if (transferError(homography, points0, points1, k) < MAX_ERROR_PX) continue;
    const [first, second] = [project(homography, points0[2 * k], points0[2 * k + 1]), [across[k], down[k]]]
      .map(([x, y]) => [(x - left) / scale - 0.5, (y - top) / scale - 0.5, 1]);
    if (Number.isFinite(first[0] + first[1])) off.push({ first, line: cross(first, second) });
  }
  if (off.length < 3 || !width || !height) return false;
  const random = generator(1);
  const draw = () => off[Math.floor(random() * off.length)].line;
  let agreeing = 0;
  for (let round = 0; round < EPIPOLES; round++) {
    const epipole = cross(draw(), draw());
    const length = Math.hypot(...epipole);
    if (length <= 1e-12) continue;
    const [x, y, z] = epipole.map((value) => value / length);
    let near = 0;
    for (const { first: [u, v], line } of off) {
      const miss = Math.abs(x * line[0] + y * line[1] + z * line[2]);
      if (miss < MAX_EPIPOLE_DISTANCE_PX / scale * Math.max(1e-12, Math.hypot(y - z * v, z * u - x))) near++;
    }
    agreeing = Math.max(agreeing, near);
  }
  const chance = 2 * MAX_EPIPOLE_DISTANCE_PX * Math.hypot(width, height) / Math.max(width * height, 1);
  return agreeing >= MIN_FRACTION_OF_REST * off.length
    && agreeing >= MIN_FRACTION_OF_PLANE * (count - off.length)
    && log10Nfa(off.length, agreeing, 2, chance) < MAX_LOG10_NFA;
}

const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];

const sum = (values) => values.reduce((total, value) => total + value, 0);

/** Counts the inliers that are separated from each other in both images. */
function countPlaces(points0, points1, inliers, sizes) {
  const [apart0, apart1] = sizes.map((size) => PLACE_WIDTH * Math.hypot(...size));
  const isNear = (points, j, k, apart) =>
    Math.hypot(points[2 * j] - points[2 * k], points[2 * j + 1] - points[2 * k + 1]) < apart;
  const places = [];
  for (const k of rowsOf(inliers)) {
    if (!places.some((j) => isNear(points0, j, k, apart0) || isNear(points1, j, k, apart1))) places.push(k);
  }
  return places.length;
}

/** Returns the log10 number of false alarms: geometries with as many inliers among random matches. */
function log10NfaOf(model, inliers, [width, height]) {
  const chance = model === "homography" ? Math.PI * MAX_ERROR_PX ** 2 / (width * height)
                                        : 2 * MAX_ERROR_PX * Math.hypot(width, height) / (width * height);
  return log10Nfa(inliers.length, sum(inliers), MODELS[model].sample, chance);
}

function log10Nfa(total, agreeing, sample, chance) {
  if (agreeing <= sample) return Infinity;
  return Math.log10(total - sample) + log10Choose(total, agreeing)
    + log10Choose(agreeing, sample) + (agreeing - sample) * Math.log10(Math.min(1, chance));
}

function log10Choose(total, chosen) {
  let result = 0;
  for (let k = 1; k <= chosen; k++) result += Math.log10((total - chosen + k) / k);
  return result;
}

function ransac(model, points0, points1) {
  const { sample, fit, error } = MODELS[model];
  const count = points0.length / 2;
  const random = generator(1);
  let best = { model, matrix: null, inliers: new Uint8Array(count) };
  let most = 0;
  const judge = (matrix) => {
    const inliers = new Uint8Array(count);
    let agreeing = 0;
    for (let k = 0; matrix && k < count; k++) {
      if (error(matrix, points0, points1, k) <= MAX_ERROR_PX) agreeing += inliers[k] = 1;
    }
    if (agreeing <= most) return false;
    [most, best] = [agreeing, { model, matrix, inliers }];
    return true;
  };
  const places = [...best.inliers.keys()];
  let needed = ROUNDS;
  for (let round = 0; count > sample && round < needed; round++) {
    const rows = new Set();
    while (rows.size < sample) rows.add(Math.floor(random() * count));
    if (!judge(fit(points0, points1, [...rows]))) continue;
    let local = best.matrix; // local optimisation: all near matches give a better fit than a sample
    for (const reach of LOCAL_REACHES) {
      const near = places.filter((k) => error(local, points0, points1, k) <= reach * MAX_ERROR_PX);
      local = fit(points0, points1, near);
      if (!local) break;
      judge(local);
    }
    const miss = Math.log(1 - Math.min(0.999999, (most / count) ** sample));
    needed = Math.min(ROUNDS, Math.ceil(Math.log(1e-4) / miss));
  }
  return best;
}

const rowsOf = (inliers) => [...inliers.keys()].filter((k) => inliers[k]);

/** Returns a generator of reproducible random numbers (mulberry32). */
function generator(seed) {
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let value = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    value = (value + Math.imul(value ^ (value >>> 7), 61 | value)) ^ value;
    return ((value ^ (value >>> 14)) >>> 0) / 2 ** 32;
  };
}

/** Maps a point by a homography. */
export function project(matrix, x, y) {
  const w = matrix[6] * x + matrix[7] * y + matrix[8];
  return [(matrix[0] * x + matrix[1] * y + matrix[2]) / w,
          (matrix[3] * x + matrix[4] * y + matrix[5]) / w];
}

function transferError(matrix, points0, points1, k) {
  const [x, y] = project(matrix, points0[2 * k], points0[2 * k + 1]);
  return Math.hypot(x - points1[2 * k], y - points1[2 * k + 1]);
}

/** Returns the larger distance of the two points from the epipolar line of the other. */
function epipolarError(f, points0, points1, k) {
  const [x, y, u, v] = [points0[2 * k], points0[2 * k + 1], points1[2 * k], points1[2 * k + 1]];
  const line1 = [f[0] * x + f[1] * y + f[2], f[3] * x + f[4] * y + f[5]];
  const line0 = [f[0] * u + f[3] * v + f[6], f[1] * u + f[4] * v + f[7]];
  const residual = Math.abs(u * line1[0] + v * line1[1] + f[6] * x + f[7] * y + f[8]);
  return residual / Math.max(1e-12, Math.min(Math.hypot(...line0), Math.hypot(...line1)));
}

/** Returns the matrix that moves points to mean 0 and mean distance sqrt 2 (Hartley, 1997). */
function normalisation(points, rows) {
  let [x, y, distance] = [0, 0, 0];
  for (const k of rows) [x, y] = [x + points[2 * k] / rows.length, y + points[2 * k + 1] / rows.length];
  for (const k of rows) distance += Math.hypot(points[2 * k] - x, points[2 * k + 1] - y) / rows.length;
  const scale = Math.SQRT2 / Math.max(distance, 1e-9);
  return [scale, 0, -scale * x, 0, scale, -scale * y, 0, 0, 1];
}

function fitHomography(points0, points1, rows) {
  const [t0, t1] = [normalisation(points0, rows), normalisation(points1, rows)];
  const found = nullVector(rows, (k) => {
    const [x, y] = project(t0, points0[2 * k], points0[2 * k + 1]);
    const [u, v] = project(t1, points1[2 * k], points1[2 * k + 1]);
    return [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]];
  });
  const matrix = multiply(invert(t1), multiply(found, t0));
  return Math.abs(matrix[8]) > 1e-12 ? matrix.map((value) => value / matrix[8]) : null;
}

function fitFundamental(points0, points1, rows) {
  const [t0, t1] = [normalisation(points0, rows), normalisation(points1, rows)];
  const found = nullVector(rows, (k) => {
    const [x, y] = project(t0, points0[2 * k], points0[2 * k + 1]);
    const [u, v] = project(t1, points1[2 * k], points1[2 * k + 1]);
    return [[u * x, u * y, u, v * x, v * y, v, x, y, 1]];
  });
  // Enforce rank two: remove the part that acts on the weakest direction.
  const gram = multiply(transpose(found), found);
  const weak = smallestEigenvector(gram, 3);
  const image = [0, 1, 2].map((r) => found[3 * r] * weak[0] + found[3 * r + 1] * weak[1] + found[3 * r + 2] * weak[2]);
  const singular = found.map((value, k) => value - image[Math.floor(k / 3)] * weak[k % 3]);
  const matrix = multiply(transpose(t1), multiply(singular, t0));
  const length = Math.hypot(...matrix);
  return length > 0 ? matrix.map((value) => value / length) : null;
}

function nullVector(rows, equations) {
  const gram = new Float64Array(81);
  for (const k of rows) {
    for (const row of equations(k)) {
      for (let i = 0; i < 9; i++) for (let j = 0; j < 9; j++) gram[9 * i + j] += row[i] * row[j];
    }
  }
  return smallestEigenvector([...gram], 9);
}

/** Returns the eigenvector of the smallest eigenvalue of a symmetric matrix (Jacobi's method). */
export function smallestEigenvector(matrix, size) {
  const a = [...matrix];
  const vectors = Array.from(a, (_, k) => (k % (size + 1) ? 0 : 1));
  for (let sweep = 0; sweep < 30; sweep++) {
    let off = 0;
    for (let p = 0; p < size; p++) {
      for (let q = p + 1; q < size; q++) {
        const value = a[p * size + q];
        off += value * value;
        if (Math.abs(value) < 1e-300) continue;
        const theta = (a[q * size + q] - a[p * size + p]) / (2 * value);
        const t = Math.sign(theta || 1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
        const c = 1 / Math.sqrt(t * t + 1);
        const s = t * c;
        for (let k = 0; k < size; k++) {
          const [left, right] = [a[k * size + p], a[k * size + q]];
          a[k * size + p] = c * left - s * right;
          a[k * size + q] = s * left + c * right;
        }
        for (let k = 0; k < size; k++) {
          const [upper, lower] = [a[p * size + k], a[q * size + k]];
          a[p * size + k] = c * upper - s * lower;
          a[q * size + k] = s * upper + c * lower;
          const [left, right] = [vectors[k * size + p], vectors[k * size + q]];
          vectors[k * size + p] = c * left - s * right;
          vectors[k * size + q] = s * left + c * right;
        }
      }
    }
    if (off < 1e-22) break;
  }
  let least = 0;
  for (let k = 1; k < size; k++) if (a[k * (size + 1)] < a[least * (size + 1)]) least = k;
  return Array.from({ length: size }, (_, k) => vectors[k * size + least]);
}

const transpose = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];

function multiply(a, b) {
  return Array.from(a, (_, k) => {
    const [r, c] = [Math.floor(k / 3) * 3, k % 3];
    return a[r] * b[c] + a[r + 1] * b[3 + c] + a[r + 2] * b[6 + c];
  });
}

function invert(m) {
  const cofactor = (i, j, k, l) => m[i] * m[j] - m[k] * m[l];
  const adjugate = [cofactor(4, 8, 5, 7), cofactor(2, 7, 1, 8), cofactor(1, 5, 2, 4),
                    cofactor(5, 6, 3, 8), cofactor(0, 8, 2, 6), cofactor(2, 3, 0, 5),
                    cofactor(3, 7, 4, 6), cofactor(1, 6, 0, 7), cofactor(0, 4, 1, 3)];
  const determinant = m[0] * adjugate[0] + m[1] * adjugate[3] + m[2] * adjugate[6];
  return adjugate.map((value) => value / determinant);
}
