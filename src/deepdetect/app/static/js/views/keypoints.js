// The keypoints of a picture: which ones, how many, and files of them.
import { positions, select } from "../selection.js";
import { composeKeypoints, drawKeypoints } from "../draw.js";
import { save, savePng, stem, toCsv, toJson } from "../downloads.js";
import { activePicture, announce, counted, element, onceAFrame, page, toOriginal } from "../page.js";

const NUMBERS = [10, 20, 50, 100, 200, 300, 500, 750, 1000, 1500, 2000, 3000, 4000, 5000, 7500,
                 10_000, 15_000, 20_000, 30_000, 50_000];
const HINTS = {
  dense: "Every pixel that passes, as detect() gives them.",
  ranked: "The best pixels of the heat map, refined to fractions of a pixel, as "
    + "detect(max_keypoints=N, mode=\"dense\") gives them. Where few keypoints are wanted, the points "
    + "of all scales, detect(max_keypoints=N) in Python, are found again more often.",
};

const view = element("view-keypoints");
const form = view.querySelector("form");
let shown = null; // the last selection: what is drawn and downloaded

/** @returns {import("../selection.js").Options} what the controls say */
function options() {
  const chosen = new FormData(form);
  const density = chosen.get("by") === "density";
  return {
    threshold: Number(element("threshold").value),
    density: density ? Number(element("density").value) / 100 : null,
    maxKeypoints: chosen.get("kind") === "ranked" ? NUMBERS[element("number").value] : null,
  };
}

function showControls({ density, maxKeypoints, threshold }) {
  element("threshold-row").hidden = density !== null;
  element("density-row").hidden = density === null;
  element("number-row").hidden = maxKeypoints === null;
  element("kind-hint").textContent = HINTS[maxKeypoints === null ? "dense" : "ranked"];
  const say = (id, text) => {
    form.querySelector(`output[for="${id}"]`).textContent = text;
    element(id).setAttribute("aria-valuetext", text);
  };
  say("threshold", threshold.toFixed(2));
  say("density", Number(element("density").value).toFixed(1));
  say("number", NUMBERS[element("number").value].toLocaleString("en"));
}

export function draw() {
  const chosen = options();
  showControls(chosen);
  const picture = activePicture();
  if (!picture) return;
  const pixels = select(picture.map, chosen);
  // Of dense keypoints the pixels are all that is drawn.
  const xy = chosen.maxKeypoints === null ? null : positions(picture.map, pixels, chosen);
  shown = { picture, options: chosen, pixels };
  const canvas = view.querySelector(".picture");
  if (canvas.source !== picture) {
    canvas.source = picture;
    [canvas.width, canvas.height] = [picture.width, picture.height];
    canvas.getContext("2d").drawImage(picture.canvas, 0, 0);
  }
  const overlay = view.querySelector(".overlay");
  const unit = picture.width / Math.max(1, canvas.clientWidth || picture.width);
  drawKeypoints(overlay, picture, pixels, xy, Math.max(1, unit));
  const density = pixels.length / (picture.width * picture.height);
  const text = `${counted(pixels.length, "keypoint")}`;
  element("count").textContent = text;
  overlay.setAttribute("aria-label", `${picture.name}: ${text}, ${(100 * density).toFixed(1)} per 100 pixels`);
}

/** Rows of x, y and probability, in the photograph's own pixels. */
function rows() {
  const { picture, pixels, options: chosen } = shown;
  const xy = positions(picture.map, pixels, chosen);
  return Array.from(pixels, (pixel, k) =>
    [...toOriginal(picture, xy[2 * k], xy[2 * k + 1]), picture.map.probability[pixel]]);
}

const downloads = {
  csv: (name) => save(`${name}_keypoints.csv`, toCsv("x,y,score", rows()), "text/csv"),
  json: (name) => {
    const { picture, options: chosen } = shown;
    const values = {
      image: picture.name, width: picture.original.width, height: picture.original.height,
      seen_as: [picture.width, picture.height],
      options: { threshold: chosen.density === null ? chosen.threshold : null,
                 density: chosen.density, max_keypoints: chosen.maxKeypoints, mode: "dense" },
      columns: ["x", "y", "score"], keypoints: rows(),
    };
    save(`${name}_keypoints.json`, toJson(values), "application/json");
  },
  png: (name) => savePng(`${name}_keypoints.png`,
                         composeKeypoints(shown.picture, view.querySelector(".overlay"))),
};

export function setUp() {
  const later = onceAFrame(draw);
  form.addEventListener("input", (event) => {
    if (event.target.name === "which-keypoints") page.active = Number(event.target.value);
    for (const layers of view.querySelectorAll(".layers")) {
      layers.classList.toggle("actual", element("actual-keypoints").checked);
    }
    later();
  });
  form.addEventListener("change", () => announce(element("count").textContent));
  for (const button of form.querySelectorAll("[data-download]")) {
    button.onclick = () => shown && downloads[button.dataset.download](stem(shown.picture.name));
  }
}

/** The best keypoints of a picture for matching. */
export function bestKeypoints(picture, count) {
  const chosen = { threshold: 0.5, density: null, maxKeypoints: count };
  return positions(picture.map, select(picture.map, chosen), chosen);
}
