// Matches of two pictures by descriptors, their lines, and the geometry that they agree with.
import { Background } from "../background.js";
import { describe, findPoints } from "../detection.js";
import { drawMatches, newCanvas } from "../draw.js";
import { save, savePng, stem, toCsv, toJson } from "../downloads.js";
import { announce, counted, during, element, onceAFrame, page, rescaled, showError, toOriginal } from "../page.js";
import { choosePoints } from "../points/detection.js";

const NARROW_PX = 640; // below it the pictures stand above each other
const SAVED_WIDTH_PX = 1600;
const MODELS = {
  homography: "one homography: a plane, or a turn of the camera",
  fundamental: "one epipolar geometry: a scene with depth",
};

const view = element("view-matches");
const form = view.querySelector("form");
const background = new Background(new URL("../matching_worker.js", import.meta.url));
let found = null; // mutual matches of the pictures with their ratios
let pending = null; // the matching that is at work, or was the last
let kept = null; // those under the ratio, with their geometry
let [matchings, filterings] = [0, 0]; // how many were begun: only what the last one finds is shown

export const matchingTask = (task, values) => background.call(task, values);

const count = () => Number(element("match-number").value);
const ratio = () => Number(element("ratio").value);

function showControls() {
  form.querySelector('output[for="match-number"]').textContent = count().toLocaleString("en");
  form.querySelector('output[for="ratio"]').textContent = ratio().toFixed(2);
}

/** The described points of a picture, and the size that they were found in. */
async function pointsOf(picture, number) {
  await findPoints(picture);
  const { width, height } = picture.ranking;
  const { xy, sizes } = choosePoints(picture.ranking, number);
  return { width, height, xy, ...await during("Describing points…", describe(picture, { xy, sizes })) };
}

/** Matches the pictures where that has not been done, and finds their geometry. */
export async function match() {
  showControls();
  const [first, second] = page.pictures;
  if (!second) return;
  const key = [first, second, count()];
  const same = (other) => other?.key.every((value, k) => value === key[k]);
  if (!same(pending)) {
    const own = ++matchings; // what is at work for other options is not wanted any more
    pending = { key, done: same(found) ? null : matchNew(key, () => own === matchings) };
  }
  const own = pending;
  try {
    await own.done;
  } catch (error) {
    if (own !== pending) return;
    pending = null; // it may be tried again
    throw error;
  }
}

/** Matches pictures, and finds the geometry of their matches. */
async function matchNew(key, isWanted) {
  const [first, second, number] = key;
  const pictures = [];
  for (const picture of [first, second]) {
    pictures.push(await pointsOf(picture, number));
    if (!isWanted()) return;
  }
  const result = await during("Matching…", background.call("match", { pictures }));
  if (!isWanted()) return;
  const seen = (points, from, to) => Float32Array.from(points, (_, k) =>
    rescaled(points[k - k % 2], points[k - k % 2 + 1], from, to)[k % 2]);
  result.points0 = seen(result.points0, pictures[0], first);
  result.points1 = seen(result.points1, pictures[1], second);
  found = { key, ...result };
  await filter();
}

/** Keeps the matches under the ratio, and estimates the geometry that they agree with. */
async function filter() {
  showControls();
  if (!found) return;
  const own = ++filterings;
  const [{ key }, largest] = [found, ratio()];
  const rows = [...found.ratios.keys()].filter((k) => found.ratios[k] < largest);
  const take = (points) => Float32Array.from({ length: 2 * rows.length },
                                             (_, k) => points[2 * rows[k >> 1] + (k & 1)]);
  const [points0, points1] = [take(found.points0), take(found.points1)];
  const [first, second, keypoints] = key;
  const sizes = [first, second].map(({ width, height }) => [width, height]);
  const geometry = await background.call("geometry", { points0, points1, sizes });
  if (own !== filterings) return;
  const options = { keypoints, ratio: largest, mutual: true };
  const ratios = Float32Array.from(rows, (k) => found.ratios[k]);
  kept = { first, second, options, points0, points1, ratios, ...geometry };
  draw();
  announce(element("match-count").textContent);
}

/** The matches with their geometry, once they are there. */
export async function matched() {
  await match();
  return kept;
}

/** Which rows are drawn and saved. */
function rowsShown() {
  const only = element("agreeing").checked && kept.model !== "none";
  return [...kept.ratios.keys()].filter((k) => !only || kept.inliers[k]);
}

export function draw() {
  showControls();
  const pair = page.pictures.length === 2;
  view.querySelector(".empty").hidden = pair;
  const canvas = view.querySelector(".lines");
  canvas.hidden = !pair || !kept;
  if (!pair || !kept) return;
  const width = Math.max(200, view.querySelector(".stage").clientWidth - 22);
  const drawn = paint(canvas, width * devicePixelRatio, width < NARROW_PX);
  canvas.style.width = `${canvas.width / devicePixelRatio}px`;
  const agreeing = kept.inliers.reduce((sum, value) => sum + value, 0);
  const text = counted(kept.ratios.length, "match");
  element("match-count").textContent = text;
  const doubt = kept.ratios.length ? "No geometry explains them better than chance: most may be wrong."
                                   : "Nothing in one picture is like anything in the other.";
  const hint = kept.model === "none" ? doubt
    : `${agreeing.toLocaleString("en")} agree with ${MODELS[kept.model]}.`;
  const sample = drawn < rowsShown().length ? ` ${drawn} of them are drawn.` : "";
  element("match-hint").textContent = hint + sample;
  canvas.setAttribute("aria-label", `${text} between ${kept.first.name} and ${kept.second.name}`);
}

function paint(canvas, width, stacked) {
  const rows = rowsShown();
  const take = (points) => Float32Array.from({ length: 2 * rows.length },
                                             (_, k) => points[2 * rows[k >> 1] + (k & 1)]);
  const good = rows.map((k) => kept.model === "none" || kept.inliers[k] === 1);
  return drawMatches(canvas, [kept.first, kept.second], take(kept.points0), take(kept.points1), good,
              { stacked, width });
}

/** Rows of x0, y0, x1, y1, score and inlier, in the photographs' own pixels. */
function rowsSaved() {
  const place = (picture, points, k) => toOriginal(picture, points[2 * k], points[2 * k + 1]);
  return rowsShown().map((k) => [...place(kept.first, kept.points0, k),
                                 ...place(kept.second, kept.points1, k),
                                 1 - kept.ratios[k], kept.inliers[k]]);
}

const downloads = {
  csv: (name) => save(`${name}.csv`, toCsv("x0,y0,x1,y1,score,inlier", rowsSaved()), "text/csv"),
  json: (name) => {
    const values = {
      images: [kept.first.name, kept.second.name], model: kept.model,
      matrix: kept.matrix, matrix_of: [kept.first, kept.second].map((p) => [p.width, p.height]),
      options: kept.options, columns: ["x0", "y0", "x1", "y1", "score", "inlier"], matches: rowsSaved(),
    };
    save(`${name}.json`, toJson(values), "application/json");
  },
  png: (name) => {
    const canvas = newCanvas(1, 1);
    paint(canvas, SAVED_WIDTH_PX, false);
    return savePng(`${name}.png`, canvas);
  },
};

/** Forgets the matches of pictures that are gone. */
export function reset() {
  [found, pending, kept] = [null, null, null];
  matchings++;
  filterings++;
  element("match-count").textContent = "–";
  element("match-hint").textContent = "";
}

export function setUp() {
  const guarded = (task) => () => task().catch((error) => showError(error.message));
  const refilter = onceAFrame(guarded(filter));
  element("ratio").oninput = () => {
    showControls();
    refilter();
  };
  element("match-number").oninput = showControls;
  element("match-number").onchange = guarded(match);
  element("agreeing").onchange = draw;
  addEventListener("resize", onceAFrame(() => !view.hidden && draw()));
  for (const button of form.querySelectorAll("[data-download]")) {
    button.onclick = () => kept && downloads[button.dataset.download](
      `${stem(kept.first.name)}_${stem(kept.second.name)}_matches`);
  }
}
