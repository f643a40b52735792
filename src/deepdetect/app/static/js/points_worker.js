// Worker that ranks and describes points of images, by ONNX Runtime in the browser or by Python.
import { UserError, answer } from "./background.js";
import { decode } from "./decoding.js";
import { TURNED_KEYPOINTS } from "./learned.js";
import { dominantAngles } from "./orientation.js";
import { GRAY, luma, pointsSize, reduceByArea } from "./pixels.js";
import { ALL_CANDIDATES, rankingOf } from "./points/ranking.js";
import { askPython, openModel } from "./runtime.js";

const STRIDE = 128; // the descriptor network halves an image seven times
const models = {};

async function opened(name) {
  try {
    return models[name] ??= await openModel(name);
  } catch (error) {
    if (error instanceof UserError) throw error;
    throw new UserError(`The models for points could not be loaded (${error.message}): load the page again.`);
  }
}

/** Returns candidates, strongest first: x, y, sigmas and logits. Python returns all of them. */
async function candidatesOf({ gray, width, height }, limit, token) {
  if (token !== null) {
    const rows = await askPython("candidates", width, height, gray, token);
    const count = rows.length / 4;
    const [x, y, sigmas, logits] = [0, 1, 2, 3].map((k) => rows.subarray(k * count, (k + 1) * count));
    return { x, y, sigmas, logits };
  }
  const model = await opened("points.onnx");
  return model({ gray: ["uint8", gray, [1, 1, height, width]],
                 limit: ["int64", BigInt64Array.of(BigInt(limit)), [1]] });
}

/** Returns the place of a pixel outside an image in the image, which is reflected at its border. */
function reflected(place, side) {
  const within = place % Math.max(1, 2 * (side - 1));
  return Math.min(within, Math.abs(2 * (side - 1) - within));
}

/** Returns upright descriptors of points, rows of 64 numbers. */
async function uprightDescriptors({ gray, width, height, points: { xy, sizes } }, token) {
  const count = sizes.length;
  if (!count) return new Float32Array(0);
  if (token !== null) return askPython("descriptors", width, height, new Blob([gray, xy, sizes]), token);
  const model = await opened("descriptor.onnx");
  const [across, down] = [width, height].map((side) => STRIDE * Math.ceil(side / STRIDE));
  const luma = new Float32Array(across * down);
  for (let y = 0, at = 0; y < down; y++) {
    const start = reflected(y, height) * width;
    for (let x = 0; x < across; x++) luma[at++] = gray[start + reflected(x, width)] / 255;
  }
  const { descriptors } = await model({
    luma: ["float32", luma, [1, 1, down, across]],
    xy: ["float32", xy, [1, count, 2]],
    sizes: ["float32", sizes, [1, count]],
  });
  return descriptors;
}

/** Returns the luma of a file at the size at which points are detected. */
function reducedLuma(file, name) {
  return decode(file, name, ({ width, height }, readRows) => {
    const [newWidth, newHeight] = pointsSize(width, height);
    const gray = reduceByArea((top, rows) => luma(readRows(top, rows)), width, height, newWidth,
                              newHeight, GRAY);
    return { gray: new Uint8Array(gray.buffer), width: newWidth, height: newHeight };
  });
}

answer({
  /**
   * Ranks the candidates of an image, whose file is read again if the network's input was scaled
   * down. The token is Python's, or null if the page runs in the browser only.
   */
  async rank({ file, name, rgba, width, height, original, limit, token }) {
    const whole = width === original.width && height === original.height;
    const seen = whole ? { gray: luma(rgba), width, height } : await reducedLuma(file, name);
    const ranked = token === null ? limit : ALL_CANDIDATES;
    return { ...seen, limit: ranked, ...rankingOf(await candidatesOf(seen, limit, token)) };
  },

  /** @returns {Float32Array} angles of the points in degrees */
  angles: ({ gray, width, height, points }) => dominantAngles(gray, width, height, points),

  /** Describes points. @returns {Promise<import("./learned.js").Described>} */
  async describe({ token, ...picture }) {
    const { gray, width, height, points: { xy, sizes } } = picture;
    const best = { xy: xy.subarray(0, 2 * TURNED_KEYPOINTS), sizes: sizes.subarray(0, TURNED_KEYPOINTS) };
    return { upright: await uprightDescriptors(picture, token),
             angles: dominantAngles(gray, width, height, best) };
  },
}, (reason) => `The points could not be found (${reason}): try a smaller image.`);
