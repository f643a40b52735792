// State, messages and helpers shared by all parts of the page.

export const element = (id) => document.getElementById(id);

/**
 * @typedef {object} Picture
 * @property {string} name @property {File} file
 * @property {number} width @property {number} height at the size of the network's input
 * @property {{width: number, height: number}} original
 * @property {Uint8ClampedArray} rgba @property {HTMLCanvasElement} canvas
 * @property {AbortController} removal cancels the work for this image
 * @property {import("./selection.js").HeatMap} [map] after the network has run (`findHeatMap`)
 * @property {import("./points/ranking.js").Ranking & {gray: Uint8Array, width: number, height: number, limit: number}}
 *   [ranking] after its points were ranked (`findPoints`)
 */

export const page = {
  /** @type {Picture[]} */
  pictures: [],
  /** Index of the displayed image in views of one image. */
  active: 0,
  /** Description of the server; null if the page runs in the browser only. */
  server: null,
  token: "",
};

/** The displayed image. */
export const activePicture = () => page.pictures[page.active] ?? page.pictures[0];

export function showError(message) {
  const box = element("error");
  box.querySelector("p").textContent = message;
  box.hidden = !message;
}

/** Runs a task and shows the message of its error. */
export const reported = (task) => task().catch((error) => showError(error.message));

/** Announces a text to screen readers. */
export function announce(text) {
  element("status").textContent = text;
}

let busy = 0;

/** Shows a text about the running work until a promise settles. */
export async function during(text, promise) {
  busy++;
  element("busy").lastElementChild.textContent = text;
  element("busy").hidden = false;
  announce(text);
  try {
    return await promise;
  } finally {
    element("busy").hidden = --busy === 0;
  }
}

export const counted = (number, word) =>
  `${number.toLocaleString("en")} ${word}${number === 1 ? "" : word.endsWith("ch") ? "es" : "s"}`;

/** Returns the same position in an image of another size. */
export const rescaled = (x, y, from, to) =>
  [(x + 0.5) * to.width / from.width - 0.5, (y + 0.5) * to.height / from.height - 0.5];

/** Returns (N, 2) positions, stored one after the other, in an image of another size. */
export const allRescaled = (xy, from, to) => Float32Array.from(xy, (_, k) =>
  rescaled(xy[k - k % 2], xy[k - k % 2 + 1], from, to)[k % 2]);

/** Returns a position in pixels of the original image, which may have been scaled down. */
export const toOriginal = (picture, x, y) => rescaled(x, y, picture, picture.original);

/** Returns the scale from one image size to another, as the mean of both sides. */
export const enlargement = (from, to) => (to.width / from.width + to.height / from.height) / 2;

/** Returns a function that runs another one at most once a frame, with the last state. */
export function onceAFrame(draw) {
  let waiting = false;
  return () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      draw();
    });
  };
}
