// The heat map of a picture, over the picture.
import { drawHeatMap } from "../draw.js";
import { savePng, stem } from "../downloads.js";
import { activePicture, element, onceAFrame, page } from "../page.js";

const view = element("view-heatmap");
const form = view.querySelector("form");

export function draw() {
  const opacity = Number(element("opacity").value);
  form.querySelector('output[for="opacity"]').textContent = `${opacity} %`;
  const picture = activePicture();
  if (!picture) return;
  const overlay = view.querySelector(".overlay");
  overlay.style.opacity = String(opacity / 100);
  if (overlay.source === picture) return;
  overlay.source = picture;
  const canvas = view.querySelector(".picture");
  [canvas.width, canvas.height] = [picture.width, picture.height];
  canvas.getContext("2d").drawImage(picture.canvas, 0, 0);
  drawHeatMap(overlay, picture.map);
}

export function setUp() {
  const later = onceAFrame(draw);
  form.addEventListener("input", (event) => {
    if (event.target.name === "which-heatmap") page.active = Number(event.target.value);
    view.querySelector(".layers").classList.toggle("actual", element("actual-heatmap").checked);
    later();
  });
  form.querySelector("[data-download]").onclick = () => {
    const picture = activePicture();
    if (picture) savePng(`${stem(picture.name)}_heatmap.png`, view.querySelector(".overlay"));
  };
}
