// Worker that reads images and runs the network, by ONNX Runtime in the browser or by Python.
import { UserError, answer } from "./background.js";
import { decode } from "./decoding.js";
import { isConstant, networkSize, reduceByArea, toPlanes } from "./pixels.js";
import { askPython, openModel } from "./runtime.js";
import { prepare } from "./selection.js";

let runNetwork = null;

const tasks = {
  /** Opens the network. @returns {Promise<string>} a description of its runtime */
  async open({ engine, token, processor }) {
    const opened = engine === "python" ? pythonNetwork(token) : await openedHere(processor);
    runNetwork = opened.run;
    return opened.words;
  },

  /** Decodes a file, upright, and scales it down to the size of the network's input. */
  read({ file, name }) {
    return decode(file, name, ({ width, height }, readRows) => {
      const [newWidth, newHeight] = networkSize(width, height);
      const reduced = width !== newWidth || height !== newHeight;
      const rgba = reduced ? reduceByArea(readRows, width, height, newWidth, newHeight)
                           : readRows(0, height);
      return { rgba, width: newWidth, height: newHeight, original: { width, height } };
    });
  },

  /** Computes the heat map of pixels that `read` returned. */
  async run({ rgba, width, height }) {
    const logits = isConstant(rgba) ? new Float32Array(width * height).fill(-Infinity)
                                    : await runNetwork(rgba, width, height);
    return prepare(logits, width, height);
  },
};

async function openedHere(processor) {
  try {
    return await browserNetwork(processor);
  } catch (error) {
    if (error instanceof UserError) throw error;
    throw new UserError(`The network could not be loaded (${error.message}): load the page again.`);
  }
}

async function browserNetwork(processor) {
  const graphics = processor === "graphics";
  const model = await openModel("default.onnx", graphics);
  const runOne = async (rgba, width, height) => {
    const planes = toPlanes(rgba, width * height);
    const { logits } = await model({ image: ["float32", planes, [1, 3, height, width]] }, ["logits"]);
    return Float32Array.from(logits);
  };
  let last = Promise.resolve();
  const run = (...picture) => { // one after the other: with WebGPU two at once would never end
    const own = last.then(() => runOne(...picture));
    last = own.catch(() => {});
    return own;
  };
  const words = graphics ? "on the graphics card (WebGPU)" : "on the processor (WebAssembly)";
  return { run, words };
}

function pythonNetwork(token) {
  const run = (rgba, width, height) => {
    const rgb = new Uint8Array(3 * width * height);
    for (let k = 0, j = 0; k < rgba.length; k += 4) {
      rgb[j++] = rgba[k];
      rgb[j++] = rgba[k + 1];
      rgb[j++] = rgba[k + 2];
    }
    return askPython("heatmap", width, height, rgb, token);
  };
  return { run, words: "in Python on this computer" };
}

answer(tasks, (reason) => `The image could not be processed (${reason}): try a smaller one.`);
