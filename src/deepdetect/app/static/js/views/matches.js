// View of the matches of two images by descriptors, and of their geometry.
import { Background } from "../background.js";
import { describe, findPoints } from "../detection.js";
import { drawMatches, nearestLine, newCanvas } from "../draw.js";
import { save, savePng, stem, toCsv, toJson } from "../downloads.js";
import { allRescaled, announce, counted, during, element, onceAFrame, page, reported, toOriginal } from "../page.js";
import { candidatesFor, choosePoints } from "../points/detection.js";

const NARROW_PX = 640; // on a narrower page, the images are stacked
const SAVED_WIDTH_PX = 1600;
const MAX_ZOOM = 8;
const MAX_WIDTH_PX = 4096; // largest width of a canvas; further zooming only enlarges its pixels
const HOVER_PX = 8; // distance of the pointer from a line, in pixels of the screen
const MODELS = {
  homography: "one homography: a plane, or a rotated camera",
  fundamental: "one epipolar geometry: a scene with depth",
};

const view = element("view-matches");
const form = view.querySelector("form");
const stage = view.querySelector(".stage");
const canvas = view.querySelector(".lines");
const background = new Background(new URL("../matching_worker.js", import.meta.url));
let found = null; // mutual matches of the images, with their ratios
let pending = null; // the running matching, or the last one
let kept = null; // matches that pass the ratio test, with their geometry
let [zoom, lines, hovered] = [1, [], null]; // state of the drawing
let [matchings, filterings, comparisons] = [0, 0, 0]; // numbers of starts: only the last one's result counts

export const matchingTask = (task, values) => background.call(task, values);

const count = () => Number(element("match-number").value);
const ratio = () => Number(element("ratio").value);

function showControls() {
  form.querySelector('output[for="match-number"]').textContent = count().toLocaleString("en");
  form.querySelector('output[for="ratio"]').textContent = ratio().toFixed(2);
  form.querySelector('output[for="thickness"]').textContent = element("thickness").value;
}

/** Returns the described points of an image, and the image size in which they were found. */
async function pointsOf(picture, number) {
  await findPoints(picture, candidatesFor(number));
  const { width, height } = picture.ranking;
  const { xy, sizes } = choosePoints(picture.ranking, number);
  return { width, height, xy, ...await during("Describing points…", describe(picture, { xy, sizes })) };
}

/** Matches the images, unless that is done, and estimates their geometry. */
export async function match() {
  showControls();
  const [first, second] = page.pictures;
  if (!second) return;
  const key = [first, second, count()];
  const same = (other) => other?.key.every((value, k) => value === key[k]);
  if (!same(pending)) {
    const own = ++matchings; // the result of a running matching with other options is dropped
    pending = { key, done: same(found) ? null : matchNew(key, () => own === matchings) };
  }
  const own = pending;
  try {
    await own.done;
  } catch (error) {
    if (own !== pending) return;
    pending = null; // allows another attempt
    throw error;
  }
}

/** Matches images, and estimates the geometry of their matches. */
async function matchNew(key, isWanted) {
  const [first, second, number] = key;
  const pictures = [];
  for (const picture of [first, second]) {
    pictures.push(await pointsOf(picture, number));
    if (!isWanted()) return;
  }
  const result = await during("Matching…", background.call("match", { pictures }));
  if (!isWanted()) return;
  result.points0 = allRescaled(result.points0, pictures[0], first);
  result.points1 = allRescaled(result.points1, pictures[1], second);
  found = { key, ...result };
  await filter();
  reported(compareWithSift);
}

/** Shows how many matches SIFT finds in the same images, if the user wants that. */
async function compareWithSift() {
  const [own, output] = [++comparisons, element("sift-count")];
  output.textContent = "";
  if (!found || !element("sift").checked) return;
  const [first, second, number] = found.key;
  const pictures = [first, second].map(({ ranking: { gray, width, height } }) => ({ gray, width, height }));
  const sift = await during("Matching with SIFT…", background.call("sift", { pictures, count: number }));
  if (own !== comparisons) return;
  output.textContent = `SIFT: ${counted(sift.matches, "match")}, of which ${
    sift.agreeing.toLocaleString("en")} agree with one geometry.`;
}

/** Keeps the matches that pass the ratio test, and estimates their geometry. */
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

/** Returns the matches with their geometry, once they are found. */
export async function matched() {
  await match();
  return kept;
}

/** Returns the rows of matches that are drawn and saved. */
function rowsShown() {
  const only = element("agreeing").checked && kept.model !== "none";
  return [...kept.ratios.keys()].filter((k) => !only || kept.inliers[k]);
}

export function draw() {
  showControls();
  const pair = page.pictures.length === 2;
  view.querySelector(".empty").hidden = pair;
  canvas.hidden = !pair || !kept;
  if (!pair || !kept) return;
  const width = Math.max(200, stage.clientWidth - 22);
  const painted = Math.min(width * zoom * devicePixelRatio, Math.max(width * devicePixelRatio, MAX_WIDTH_PX));
  const fine = painted / (width * zoom); // pixels of the canvas per pixel of the screen
  lines = paint(canvas, painted, width < NARROW_PX, fine * Math.max(1, width / 1000));
  canvas.style.width = `${canvas.width / fine}px`;
  const agreeing = kept.inliers.reduce((sum, value) => sum + value, 0);
  const text = counted(kept.ratios.length, "match");
  element("match-count").textContent = text;
  const doubt = kept.ratios.length ? "No geometry explains them better than chance: most may be wrong."
                                   : "The two images have nothing similar.";
  const hint = kept.model === "none" ? doubt
    : `${agreeing.toLocaleString("en")} agree with ${MODELS[kept.model]}.`;
  const sample = lines.length < rowsShown().length ? ` ${lines.length} of them are drawn.` : "";
  element("match-hint").textContent = hint + sample;
  canvas.setAttribute("aria-label", `${text} between ${kept.first.name} and ${kept.second.name}`);
}

function paint(target, width, stacked, lineWidth) {
  const rows = rowsShown();
  const take = (points) => Float32Array.from({ length: 2 * rows.length },
                                             (_, k) => points[2 * rows[k >> 1] + (k & 1)]);
  const good = rows.map((k) => kept.model === "none" || kept.inliers[k] === 1);
  const thickness = element("thickness").value * lineWidth;
  return drawMatches(target, [kept.first, kept.second], take(kept.points0), take(kept.points1), good,
                     { stacked, width, thickness, hovered });
}

/** Returns rows of x0, y0, x1, y1, score and inlier, in pixels of the original images. */
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
    const saved = newCanvas(1, 1);
    paint(saved, SAVED_WIDTH_PX, false, SAVED_WIDTH_PX / 1000);
    return savePng(`${name}.png`, saved);
  },
};

/** Drops the matches of removed images. */
export function reset() {
  [found, pending, kept] = [null, null, null];
  [zoom, lines, hovered] = [1, [], null];
  matchings++;
  filterings++;
  comparisons++;
  element("sift-count").textContent = "";
  element("match-count").textContent = "–";
  element("match-hint").textContent = "";
}

/** Zooms the matches; the point at a position of the window stays there. */
function enlarge(factor, clientX, clientY) {
  const before = canvas.getBoundingClientRect();
  zoom = Math.max(1, Math.min(MAX_ZOOM, zoom * factor));
  draw();
  const after = canvas.getBoundingClientRect();
  stage.scrollLeft += after.left + (clientX - before.left) / before.width * after.width - clientX;
  stage.scrollTop += after.top + (clientY - before.top) / before.height * after.height - clientY;
}

function setUpStage() {
  const redraw = onceAFrame(draw);
  stage.addEventListener("wheel", (event) => {
    if (!kept || event.deltaY >= 0 && zoom === 1) return; // lets the page scroll
    event.preventDefault();
    enlarge(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.clientX, event.clientY);
  }, { passive: false });
  stage.onkeydown = ({ key }) => {
    const factor = { "+": 1.25, "=": 1.25, "-": 0.8 }[key];
    const box = stage.getBoundingClientRect();
    if (kept && factor) enlarge(factor, box.left + box.width / 2, box.top + box.height / 2);
  };
  stage.onpointermove = (event) => {
    if (event.buttons & 1) {
      stage.scrollBy(-event.movementX, -event.movementY);
      return;
    }
    const box = canvas.getBoundingClientRect();
    const fine = canvas.width / box.width; // pixels of the canvas per pixel of the screen
    const near = nearestLine(lines, (event.clientX - box.left) * fine, (event.clientY - box.top) * fine, HOVER_PX * fine);
    if (near === hovered) return;
    hovered = near;
    redraw();
  };
  stage.onpointerleave = () => {
    hovered = null;
    redraw();
  };
}

export function setUp() {
  setUpStage();
  const refilter = onceAFrame(() => reported(filter));
  element("ratio").oninput = () => {
    showControls();
    refilter();
  };
  element("match-number").oninput = showControls;
  element("match-number").onchange = () => reported(match);
  element("sift").onchange = () => reported(compareWithSift);
  element("agreeing").onchange = element("thickness").oninput = draw;
  addEventListener("resize", onceAFrame(() => !view.hidden && draw()));
  for (const button of form.querySelectorAll("[data-download]")) {
    button.onclick = () => kept && reported(async () => downloads[button.dataset.download](
      `${stem(kept.first.name)}_${stem(kept.second.name)}_matches`));
  }
}
