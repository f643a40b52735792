// Ranks the points of pictures, and finds their angles, beside the page. The network is not needed.
import { UserError, answer } from "./background.js";
import { decode } from "./decoding.js";
import { dominantAngles } from "./orientation.js";
import { GRAY, luma, pointsSize, reduceByArea } from "./pixels.js";
import { readRanker } from "./points/ranker.js";
import { rankCandidates } from "./points/ranking.js";

let ranker = null;

async function loadRanker() {
  const problem = (what) => new UserError(`Points need model/ranker.npz, which ${what}.`);
  let response;
  try {
    response = await fetch(new URL("../model/ranker.npz", import.meta.url));
  } catch {
    throw problem("could not be loaded: check the connection, and try again");
  }
  if (!response.ok) throw problem("is missing where this page comes from: install it there again");
  try {
    return readRanker(await response.arrayBuffer());
  } catch (error) {
    throw problem(`is damaged (${error.message}): install it again where this page comes from`);
  }
}

/** The luma of a file at the size at which points are looked for. */
function reducedLuma(file, name) {
  return decode(file, name, ({ width, height }, readRows) => {
    const [newWidth, newHeight] = pointsSize(width, height);
    const gray = reduceByArea((top, rows) => luma(readRows(top, rows)), width, height, newWidth,
                              newHeight, GRAY);
    return { gray: new Uint8Array(gray.buffer), width: newWidth, height: newHeight };
  });
}

answer({
  /** Ranks the candidates of a picture; what the network sees is enough where it is the whole. */
  async rank({ file, name, rgba, width, height, original }) {
    ranker ??= await loadRanker();
    const whole = width === original.width && height === original.height;
    const seen = whole ? { gray: luma(rgba), width, height } : await reducedLuma(file, name);
    return { gray: seen.gray, ...rankCandidates(seen.gray, seen.width, seen.height, ranker) };
  },

  /** @returns {Float32Array} angles of points in degrees */
  angles: ({ gray, width, height, points }) => dominantAngles(gray, width, height, points),
}, (reason) => `The points could not be found (${reason}): try a smaller picture.`);
