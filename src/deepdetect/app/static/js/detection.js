// The heat map of an image, for which the network runs, and its points, for which it does not.
// Both are computed once, at the first request.
import { Background, CancellableBackground } from "./background.js";
import { during, page } from "./page.js";
import { ALL_CANDIDATES } from "./points/ranking.js";

const pictureWorker = new Background(new URL("picture_worker.js", import.meta.url));
const pointsWorker = new CancellableBackground(new URL("points_worker.js", import.meta.url));
let opened = null; // promise of the runtime of the network
const runs = { network: 0, points: 0 }; // counts for tests: sliders must not change them

function counted(kind) {
  document.body.dataset[`${kind}Runs`] = String(++runs[kind]);
}

export const isOpened = () => opened !== null;

/** Opens a runtime for the network, or changes it. @returns {Promise<string>} its description */
export function openNetwork(options) {
  const network = pictureWorker.call("open", options);
  opened ??= network;
  network.then(() => { opened = network; }, () => {}); // replaces one that may have failed
  return network;
}

/** Reads a file at the size of the network's input. */
export const readPicture = (file) =>
  during("Reading the image…", pictureWorker.call("read", { file, name: file.name }));

/** Runs a task once for an image and stores its result; a task that failed can run again. */
function once(picture, name, task) {
  picture.pending ??= {};
  picture.pending[name] ??= task().then((result) => {
    picture[name] = result;
  }).finally(() => {
    delete picture.pending[name];
  });
  return picture.pending[name];
}

/** Runs the network on an image, unless it has a heat map. @param {import("./page.js").Picture} picture */
export async function findHeatMap(picture) {
  if (picture.map) return;
  await once(picture, "map", async () => {
    await during("Loading the network…", opened);
    const { rgba, width, height } = picture;
    const found = pictureWorker.call("run", { rgba, width, height });
    const map = await during("Finding keypoints…", found);
    counted("network");
    return map;
  });
}

const token = () => (page.server ? page.token : null);

/** Returns whether at least `limit` of the strongest candidates of an image are ranked. */
export const isRanked = (picture, limit = ALL_CANDIDATES) => picture.ranking?.limit >= limit;

/** Ranks the points of an image, unless that is done; fails if the image is removed. */
export async function findPoints(picture, limit = ALL_CANDIDATES) {
  while (!isRanked(picture, limit)) { // a pending task may rank fewer
    await once(picture, "ranking", async () => {
      const { file, name, rgba, width, height, original } = picture;
      const values = { file, name, rgba, width, height, original, limit, token: token() };
      const found = pointsWorker.call("rank", values, picture.removal.signal);
      const ranking = await during("Finding points…", found);
      counted("points");
      return ranking;
    });
  }
}

/** Describes points of an image. @returns {Promise<import("./learned.js").Described>} */
export function describe({ ranking, removal }, points) {
  const { gray, width, height } = ranking;
  return pointsWorker.call("describe", { gray, width, height, points, token: token() }, removal.signal);
}

/** Returns the angles of points of an image. @returns {Promise<Float32Array>} degrees */
export function anglesOf({ ranking }, points) {
  const { gray, width, height } = ranking;
  return pointsWorker.call("angles", { gray, width, height, points });
}
