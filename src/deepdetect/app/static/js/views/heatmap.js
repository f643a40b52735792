// View of the heat map over its image.
import { findHeatMap } from "../detection.js";
import { drawHeatMap, showPicture } from "../draw.js";
import { savePng, stem } from "../downloads.js";
import { activePicture, element, onceAFrame, page, reported } from "../page.js";

const view = element("view-heatmap");
const form = view.querySelector("form");

/** Shows the image, and its heat map once it is computed. */
export async function show() {
  draw();
  const picture = activePicture();
  if (!picture || picture.map) return;
  await findHeatMap(picture);
  draw();
}

function draw() {
  const opacity = Number(element("opacity").value);
  form.querySelector('output[for="opacity"]').textContent = `${opacity} %`;
  const picture = activePicture();
  if (!picture) return;
  const overlay = view.querySelector(".overlay");
  overlay.style.opacity = String(opacity / 100);
  const canvas = view.querySelector(".picture");
  if (canvas.source !== picture) {
    showPicture(canvas, picture);
    overlay.getContext("2d").clearRect(0, 0, overlay.width, overlay.height);
    overlay.source = null;
  }
  if (overlay.source === picture || !picture.map) return;
  overlay.source = picture;
  drawHeatMap(overlay, picture.map);
}

export function setUp() {
  const later = onceAFrame(() => reported(show));
  form.addEventListener("input", (event) => {
    if (event.target.name === "which-heatmap") page.active = Number(event.target.value);
    view.querySelector(".layers").classList.toggle("actual", element("actual-heatmap").checked);
    later();
  });
  form.querySelector("[data-download]").onclick = () => {
    const picture = activePicture();
    if (picture?.map) {
      reported(() => savePng(`${stem(picture.name)}_heatmap.png`, view.querySelector(".overlay")));
    }
  };
}
