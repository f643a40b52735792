// Ranks the points of pictures, by ONNX Runtime here or by Python, and finds their angles, beside the
// page. The network is not needed.
import { UserError, answer } from "./background.js";
import { decode } from "./decoding.js";
import { dominantAngles } from "./orientation.js";
import { GRAY, luma, pointsSize, reduceByArea } from "./pixels.js";
import { rankingOf } from "./points/ranking.js";
import { askPython, openModel } from "./runtime.js";

let model = null;

async function openedModel() {
  try {
    return await openModel("points.onnx");
  } catch (error) {
    if (error instanceof UserError) throw error;
    throw new UserError(`What finds points could not be loaded (${error.message}): load the page again.`);
  }
}

/** Candidates, the strongest first: x, y, sigmas and logits. */
async function candidatesOf({ gray, width, height }, token) {
  if (token !== null) {
    const rows = await askPython("candidates", width, height, gray, token);
    const count = rows.length / 4;
    const [x, y, sigmas, logits] = [0, 1, 2, 3].map((k) => rows.subarray(k * count, (k + 1) * count));
    return { x, y, sigmas, logits };
  }
  model ??= await openedModel();
  return model("gray", "uint8", gray, [1, 1, height, width]);
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
  /**
   * Ranks the candidates of a picture; what the network sees is enough where it is the whole. The
   * token is that of Python, null where the browser is alone.
   */
  async rank({ file, name, rgba, width, height, original, token }) {
    const whole = width === original.width && height === original.height;
    const seen = whole ? { gray: luma(rgba), width, height } : await reducedLuma(file, name);
    return { ...seen, ...rankingOf(await candidatesOf(seen, token)) };
  },

  /** @returns {Float32Array} angles of points in degrees */
  angles: ({ gray, width, height, points }) => dominantAngles(gray, width, height, points),
}, (reason) => `The points could not be found (${reason}): try a smaller picture.`);
