// What all parts of the page share: its state, its messages, and small helpers.

export const element = (id) => document.getElementById(id);

/**
 * @typedef {object} Picture
 * @property {string} name @property {File} file
 * @property {number} width @property {number} height as the network sees it
 * @property {{width: number, height: number}} original
 * @property {Uint8ClampedArray} rgba @property {HTMLCanvasElement} canvas
 * @property {AbortController} removal ends what is done for it alone
 * @property {import("./selection.js").HeatMap} [map] once the network was run (`findHeatMap`)
 * @property {import("./points/ranking.js").Ranking & {gray: Uint8Array, width: number, height: number, limit: number}}
 *   [ranking] once its points were ranked (`findPoints`)
 */

export const page = {
  /** @type {Picture[]} */
  pictures: [],
  /** Which picture is shown where one is. */
  active: 0,
  /** What the server says of itself; null where the browser is alone. */
  server: null,
  token: "",
};

/** The picture that is shown. */
export const activePicture = () => page.pictures[page.active] ?? page.pictures[0];

export function showError(message) {
  const box = element("error");
  box.querySelector("p").textContent = message;
  box.hidden = !message;
}

/** Does something; what goes wrong is said in one sentence. */
export const reported = (task) => task().catch((error) => showError(error.message));

/** Says something to those who hear the page. */
export function announce(text) {
  element("status").textContent = text;
}

let busy = 0;

/** Shows what is being done until a promise settles. */
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

/** The same position in a picture of another size. */
export const rescaled = (x, y, from, to) =>
  [(x + 0.5) * to.width / from.width - 0.5, (y + 0.5) * to.height / from.height - 0.5];

/** All of (N, 2) positions, one after the other, in a picture of another size. */
export const allRescaled = (xy, from, to) => Float32Array.from(xy, (_, k) =>
  rescaled(xy[k - k % 2], xy[k - k % 2 + 1], from, to)[k % 2]);

/** Positions in the photograph's own pixels, where the network saw it reduced. */
export const toOriginal = (picture, x, y) => rescaled(x, y, picture, picture.original);

/** How much larger a picture is than another, on the average of both sides. */
export const enlargement = (from, to) => (to.width / from.width + to.height / from.height) / 2;

/** Runs a function at most once a frame, with the last state. */
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
