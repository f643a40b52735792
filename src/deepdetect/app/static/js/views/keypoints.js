// View of the keypoints of an image, with controls and downloads.
import { anglesOf, findHeatMap, findPoints, isRanked } from "../detection.js";
import { composeKeypoints, drawCircles, drawPixels, showPicture } from "../draw.js";
import { save, savePng, stem, toCsv, toJson } from "../downloads.js";
import { activePicture, allRescaled, announce, counted, element, enlargement, onceAFrame, page, reported,
         rescaled, toOriginal } from "../page.js";
import { choosePoints } from "../points/detection.js";
import { select } from "../selection.js";

const NUMBERS = [10, 20, 50, 100, 200, 300, 500, 750, 1000, 1500, 2000, 3000, 4000, 5000, 7500,
                 10_000, 15_000, 20_000, 30_000, 50_000];

/** The kinds of keypoints: how they are found and chosen, and a hint about them. */
const KINDS = {
  dense: {
    find: findHeatMap, isFound: (picture) => picture.map, choose: chooseDense,
    hint: "All pixels that pass. Images over two megapixels are scaled down first.",
  },
  points: {
    find: (picture) => findPoints(picture), isFound: (picture) => isRanked(picture), choose: chooseOfAllScales,
    hint: "The points of all scales that are easiest to find again in another image, with their sizes, "
      + "as from PointDetector(N). The network is not run for them.",
  },
};
const SPREADS = {
  none: "The best points, wherever they are.",
  grid: "The best point of each cell in turn, with 16 cells along the longer side.",
  anms: "Points as far from each other as their number allows (adaptive non-maximal suppression).",
};

const view = element("view-keypoints");
const form = view.querySelector("form");
let shown = null; // the last selection, which is drawn and downloaded
let isAwaited = false; // whether to announce the next number of keypoints

/** Returns the state of the controls. */
function options() {
  const chosen = new FormData(form);
  const density = chosen.get("by") === "density";
  const kind = chosen.get("kind");
  return {
    kind,
    threshold: Number(element("threshold").value),
    density: density ? Number(element("density").value) / 100 : null,
    maxKeypoints: NUMBERS[element("number").value],
    spread: chosen.get("spread"),
  };
}

function showControls({ kind, density, threshold, spread }) {
  const points = kind === "points";
  element("by-row").hidden = points;
  element("threshold-row").hidden = points || density !== null;
  element("density-row").hidden = points || density === null;
  element("number-row").hidden = kind === "dense";
  element("spread-row").hidden = !points;
  element("spread-hint").hidden = !points;
  element("kind-hint").textContent = KINDS[kind].hint;
  element("spread-hint").textContent = SPREADS[spread];
  const say = (id, text) => {
    form.querySelector(`output[for="${id}"]`).textContent = text;
    element(id).setAttribute("aria-valuetext", text);
  };
  say("threshold", threshold.toFixed(2));
  say("density", Number(element("density").value).toFixed(1));
  say("number", NUMBERS[element("number").value].toLocaleString("en"));
}

/**
 * The chosen keypoints of an image.
 *
 * @typedef {object} Selection
 * @property {number} count
 * @property {string} what a description for screen readers
 * @property {(overlay: HTMLCanvasElement, unit: number) => void} draw
 * @property {string[]} columns names of the columns in files
 * @property {() => number[][] | Promise<number[][]>} rows in pixels of the original image
 * @property {object} options options of Python that give the same keypoints in the scaled image
 */

/** @returns {Selection} */
function chooseDense(picture, chosen) {
  const pixels = select(picture.map, chosen);
  const density = pixels.length / (picture.width * picture.height);
  return {
    count: pixels.length,
    what: `${(100 * density).toFixed(1)} per 100 pixels`,
    draw: (overlay) => drawPixels(overlay, picture, pixels),
    columns: ["x", "y", "score"],
    rows: () => Array.from(pixels, (pixel) => [
      ...toOriginal(picture, pixel % picture.width, Math.floor(pixel / picture.width)),
      picture.map.probability[pixel]]),
    options: chosen.density === null ? { threshold: chosen.threshold } : { density: chosen.density },
  };
}

/** @returns {Selection} */
function chooseOfAllScales(picture, { maxKeypoints, spread }) {
  const { ranking } = picture;
  const points = choosePoints(ranking, maxKeypoints, spread);
  const { xy, scores, sizes } = points;
  const drawn = allRescaled(xy, ranking, picture);
  const enlarged = enlargement(ranking, picture.original);
  const [small, large] = [Math.min(...sizes), Math.max(...sizes)].map((size) => (size * enlarged).toFixed(1));
  return {
    count: scores.length,
    what: scores.length ? `${small} to ${large} pixels wide` : "there is nothing to find",
    draw: (overlay, unit) => drawCircles(
      overlay, picture, drawn, (k) => sizes[k] / 2 * enlargement(ranking, picture), unit),
    columns: ["x", "y", "score", "size", "angle"],
    rows: async () => {
      const angles = await anglesOf(picture, points);
      return Array.from(scores, (score, k) => [
        ...rescaled(xy[2 * k], xy[2 * k + 1], ranking, picture.original), score,
        sizes[k] * enlarged, angles[k]]);
    },
    options: { max_keypoints: maxKeypoints, spread },
  };
}

/** Shows the image, and its keypoints once they are found. */
export async function show() {
  draw();
  const picture = activePicture();
  if (!picture || shown) return;
  try {
    await KINDS[options().kind].find(picture);
  } catch (error) {
    if (page.pictures.includes(picture)) throw error; // errors of removed images do not matter
  }
  if (!shown) draw(); // each move of a slider meanwhile has waited here
}

/** Shows the image without keypoints. */
export function preview() {
  shown = null;
  const picture = activePicture();
  showPicture(view.querySelector(".picture"), picture);
  const overlay = view.querySelector(".overlay");
  overlay.setAttribute("aria-label", `${picture.name}: no keypoints yet`);
  overlay.getContext("2d").clearRect(0, 0, overlay.width, overlay.height);
  element("count").textContent = "–";
}

function draw() {
  const chosen = options();
  showControls(chosen);
  shown = null;
  const picture = activePicture();
  if (!picture) return;
  const kind = KINDS[chosen.kind];
  if (view.querySelector(".picture").source !== picture || !kind.isFound(picture)) preview();
  if (!kind.isFound(picture)) return;
  const canvas = view.querySelector(".picture");
  const overlay = view.querySelector(".overlay");
  const unit = picture.width / Math.max(1, canvas.clientWidth || picture.width);
  shown = { picture, ...kind.choose(picture, chosen) };
  shown.draw(overlay, Math.max(1, unit));
  const text = counted(shown.count, chosen.kind === "points" ? "point" : "keypoint");
  element("count").textContent = text;
  overlay.setAttribute("aria-label", `${picture.name}: ${text}, ${shown.what}`);
  if (isAwaited) announce(text);
  isAwaited = false;
}

const downloads = {
  csv: async (name) => {
    const { columns, rows } = shown;
    save(`${name}_keypoints.csv`, toCsv(columns.join(","), await rows()), "text/csv");
  },
  json: async (name) => {
    const { picture, columns, rows, options: chosen } = shown;
    const values = {
      image: picture.name, width: picture.original.width, height: picture.original.height,
      seen_as: [picture.width, picture.height], options: chosen, columns, keypoints: await rows(),
    };
    save(`${name}_keypoints.json`, toJson(values), "application/json");
  },
  png: (name) => savePng(`${name}_keypoints.png`,
                         composeKeypoints(shown.picture, view.querySelector(".overlay"))),
};

export function setUp() {
  const later = onceAFrame(() => reported(show));
  form.addEventListener("input", (event) => {
    if (event.target.name === "which-keypoints") page.active = Number(event.target.value);
    for (const layers of view.querySelectorAll(".layers")) {
      layers.classList.toggle("actual", element("actual-keypoints").checked);
    }
    later();
  });
  form.addEventListener("change", () => {
    isAwaited = true;
    later();
  });
  for (const button of form.querySelectorAll("[data-download]")) {
    button.onclick = () => shown && reported(async () =>
      downloads[button.dataset.download](stem(shown.picture.name)));
  }
}
