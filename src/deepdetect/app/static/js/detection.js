// What is found in a picture, each once, when it is first asked for: its heat map, for which the
// network is run, and its points, for which it is not.
import { Background, CancellableBackground } from "./background.js";
import { during, page } from "./page.js";
import { ALL_CANDIDATES } from "./points/ranking.js";

const pictureWorker = new Background(new URL("picture_worker.js", import.meta.url));
const pointsWorker = new CancellableBackground(new URL("points_worker.js", import.meta.url));
let opened = null; // a promise of what runs the network
const runs = { network: 0, points: 0 }; // how often: sliders must not change it

function counted(kind) {
  document.body.dataset[`${kind}Runs`] = String(++runs[kind]);
}

export const isOpened = () => opened !== null;

/** Opens what runs the network, or another. @returns {Promise<string>} what that is, in words */
export function openNetwork(options) {
  const network = pictureWorker.call("open", options);
  opened ??= network;
  network.then(() => { opened = network; }, () => {}); // the other one may have failed
  return network;
}

/** Reads a file, at the size at which the network sees it. */
export const readPicture = (file) =>
  during("Reading the picture…", pictureWorker.call("read", { file, name: file.name }));

/** Remembers the result of a task in a picture, unless it fails: then it may be tried again. */
function once(picture, name, task) {
  picture.pending ??= {};
  picture.pending[name] ??= task().then((result) => {
    picture[name] = result;
  }).finally(() => {
    delete picture.pending[name];
  });
  return picture.pending[name];
}

/** Runs the network on a picture, where that has not been done. @param {import("./page.js").Picture} picture */
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

/** Whether so many of the strongest candidates of a picture are ranked. */
export const isRanked = (picture, limit = ALL_CANDIDATES) => picture.ranking?.limit >= limit;

/** Ranks the points of a picture, where that has not been done; it fails where the picture is removed. */
export async function findPoints(picture, limit = ALL_CANDIDATES) {
  while (!isRanked(picture, limit)) { // fewer may be at work
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

/** Describes points of a picture. @returns {Promise<import("./learned.js").Described>} */
export function describe({ ranking, removal }, points) {
  const { gray, width, height } = ranking;
  return pointsWorker.call("describe", { gray, width, height, points, token: token() }, removal.signal);
}

/** The angles of points of a picture. @returns {Promise<Float32Array>} degrees */
export function anglesOf({ ranking }, points) {
  const { gray, width, height } = ranking;
  return pointsWorker.call("angles", { gray, width, height, points });
}
