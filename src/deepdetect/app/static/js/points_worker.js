// Ranks the points of pictures, and finds their angles, beside the page. The network is not needed.
import { answer } from "./background.js";
import { decode } from "./decoding.js";
import { dominantAngles } from "./orientation.js";
import { GRAY, luma, pointsSize, reduceByArea } from "./pixels.js";
import { readRanker } from "./points/ranker.js";
import { rankCandidates } from "./points/ranking.js";

let ranker = null;

async function loadRanker() {
  const response = await fetch(new URL("../model/ranker.npz", import.meta.url));
  if (!response.ok) throw new Error("the ranker's file is missing");
  return readRanker(await response.arrayBuffer());
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
  /** Ranks the candidates of a picture; what the network sees is enough where it is not reduced. */
  async rank({ file, name, rgba, width, height, original }) {
    const [newWidth] = pointsSize(original.width, original.height);
    const reduced = newWidth !== original.width;
    const seen = reduced ? await reducedLuma(file, name) : { gray: luma(rgba), width, height };
    ranker ??= await loadRanker();
    return { gray: seen.gray, ...rankCandidates(seen.gray, seen.width, seen.height, ranker) };
  },

  /** @returns {Float32Array} angles of points in degrees */
  angles: ({ gray, width, height, points }) => dominantAngles(gray, width, height, points),
}, (reason) => `The points could not be found (${reason}): try a smaller picture.`);
