// Comparison of two images: the second is warped to the first, and shown right of a movable line.
import { canvasOf, newCanvas, showPicture } from "../draw.js";
import { savePng, saveVideo, stem } from "../downloads.js";
import { during, element, page, reported } from "../page.js";
import { matched, matchingTask } from "./matches.js";

const VIDEO_S = 4; // length of the video, in which the line moves across and back

const view = element("view-wipe");
const layers = view.querySelector(".layers");
let shown = null; // the first image, and the second one as it is drawn over it

/** Draws the second image over the first one, warped if a homography fits. */
export async function prepare() {
  const [first, second] = page.pictures;
  view.querySelector(".empty").hidden = Boolean(second);
  layers.hidden = !second || !shown; // hides a comparison of other images
  if (!second) return;
  if (shown?.given === first) return draw(); // registered by Python
  const isCurrent = () => page.pictures[0] === first && page.pictures[1] === second;
  const matches = await matched();
  if (!isCurrent()) return;
  if (!matches || shown?.matches === matches) return draw();
  const fits = matches.model === "homography";
  const stretch = [second.width / first.width, 0, 0, 0, second.height / first.height, 0, 0, 0, 1];
  const target = { width: first.width, height: first.height };
  const rgba = await during("Aligning…", matchingTask("warp", {
    rgba: second.rgba, size: { width: second.width, height: second.height },
    matrix: fits ? matches.matrix : stretch, target,
  }));
  if (!isCurrent() || shown?.given === first) return;
  show(first, canvasOf(rgba, first.width, first.height), fits
    ? "The second image is registered to the first, by the homography of their matches."
    : "No homography aligns these images, so the second one is only stretched to the same size.");
  shown.matches = matches;
}

/** Shows the second image as Python has registered it. */
export function compare(bitmap) {
  const [first] = page.pictures;
  const canvas = newCanvas(first.width, first.height);
  canvas.getContext("2d").drawImage(bitmap, 0, 0, first.width, first.height);
  show(first, canvas, "The second image is registered to the first by guided matching, in Python.");
  shown.given = first;
}

/** Shows an image and another one in its frame. */
function show(first, warped, hint) {
  shown = { first, warped };
  const [below, above] = view.querySelectorAll("canvas");
  showPicture(below, first);
  [above.width, above.height] = [first.width, first.height];
  above.getContext("2d").drawImage(warped, 0, 0);
  element("wipe-hint").textContent = hint;
  layers.hidden = false;
  draw();
}

export function draw() {
  const share = Number(element("wipe").value);
  view.querySelector('output[for="wipe"]').textContent = `${Math.round(share)} %`;
  view.querySelector(".overlay").style.clipPath = `inset(0 0 0 ${share}%)`;
  view.querySelector(".edge").style.left = `${share}%`;
}

/** Draws both images on a canvas of their size, with the line at a share of the width. */
function compose(canvas, { first, warped }, share) {
  const context = canvas.getContext("2d");
  const edge = Math.round(first.width * share);
  context.drawImage(first.canvas, 0, 0);
  context.save();
  context.beginPath();
  context.rect(edge, 0, first.width - edge, first.height);
  context.clip();
  context.drawImage(warped, 0, 0);
  context.restore();
}

const downloads = {
  png: (name, canvas, pictures) => {
    compose(canvas, pictures, element("wipe").value / 100);
    return savePng(`${name}.png`, canvas);
  },
  video: (name, canvas, pictures) => during("Recording…", saveVideo(name, canvas, VIDEO_S,
    (progress) => compose(canvas, pictures, 0.5 + 0.5 * Math.cos(2 * Math.PI * progress)))),
};

export function reset() {
  shown = null;
  element("wipe-hint").textContent = "";
}

export function setUp() {
  element("wipe").oninput = draw;
  const drag = (event) => {
    const box = layers.getBoundingClientRect();
    element("wipe").value = String(100 * (event.clientX - box.left) / box.width);
    draw();
  };
  layers.onpointerdown = (event) => {
    layers.setPointerCapture(event.pointerId);
    drag(event);
  };
  layers.onpointermove = (event) => layers.hasPointerCapture(event.pointerId) && drag(event);
  for (const button of view.querySelectorAll("[data-download]")) {
    button.onclick = () => {
      if (!shown) return;
      const { first } = shown;
      reported(() => downloads[button.dataset.download](
        `${stem(first.name)}_wipe`, newCanvas(first.width, first.height), shown));
    };
  }
}
