// Reads pictures and runs the network, beside the page: by ONNX Runtime here, or by Python.
import { UserError, answer } from "./background.js";
import { decode } from "./decoding.js";
import { isConstant, networkSize, reduceByArea, toPlanes } from "./pixels.js";
import { prepare } from "./selection.js";

const MAX_THREADS = 4;
const GZIP = [0x1f, 0x8b]; // the first bytes of such a file

let runNetwork = null;

const tasks = {
  /** Opens the network. @returns {Promise<string>} what runs it, in words */
  async open({ engine, token, processor }) {
    const opened = engine === "python" ? pythonNetwork(token) : await openedHere(processor);
    runNetwork = opened.run;
    return opened.words;
  },

  /** Decodes a file, upright, and reduces it to the size at which the network sees it. */
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

/** The content of a file that the build has compressed, and that some web servers unpack themselves. */
async function unpacked(address) {
  const response = await fetch(address);
  if (!response.ok) throw new Error("a file of ONNX Runtime is missing");
  const content = await response.arrayBuffer();
  const [first, second] = new Uint8Array(content);
  if (first !== GZIP[0] || second !== GZIP[1]) return content;
  if (typeof DecompressionStream === "undefined") {
    throw new UserError("This browser is too old to run the network: use one of 2023 or later.");
  }
  return new Response(new Blob([content]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function openedHere(processor) {
  try {
    return await browserNetwork(processor);
  } catch (error) {
    if (error instanceof UserError) throw error;
    throw new UserError(`The network could not be loaded (${error.message}): load the page again.`);
  }
}

async function browserNetwork(processor) {
  const folder = new URL("../ort/", import.meta.url).href;
  const graphics = processor === "graphics";
  const ort = await import(`${folder}ort.${graphics ? "webgpu" : "wasm"}.min.mjs`);
  ort.env.logLevel = "error";
  ort.env.wasm.wasmPaths = folder;
  ort.env.wasm.wasmBinary = await unpacked(
    `${folder}ort-wasm-simd-threaded.${graphics ? "asyncify." : ""}wasm.packed`);
  ort.env.wasm.numThreads = self.crossOriginIsolated
    ? Math.min(MAX_THREADS, navigator.hardwareConcurrency || 1) : 1;
  const response = await fetch(new URL("../model/default.onnx", import.meta.url));
  if (!response.ok) throw new Error("the network's file is missing");
  const session = await ort.InferenceSession.create(
    new Uint8Array(await response.arrayBuffer()),
    { executionProviders: [graphics ? "webgpu" : "wasm"] });
  const run = async (rgba, width, height) => {
    const planes = toPlanes(rgba, width * height);
    const image = new ort.Tensor("float32", planes, [1, 3, height, width]);
    const { logits } = await session.run({ image }, ["logits"]);
    return Float32Array.from(logits.data);
  };
  const words = graphics ? "on the graphics card (WebGPU)" : "on the processor (WebAssembly)";
  return { run, words };
}

function pythonNetwork(token) {
  const run = async (rgba, width, height) => {
    const rgb = new Uint8Array(3 * width * height);
    for (let k = 0, j = 0; k < rgba.length; k += 4) {
      rgb[j++] = rgba[k];
      rgb[j++] = rgba[k + 1];
      rgb[j++] = rgba[k + 2];
    }
    let response;
    try {
      response = await fetch(`/api/heatmap?width=${width}&height=${height}`, {
        method: "POST", body: rgb,
        headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/octet-stream" },
      });
    } catch {
      throw new UserError("The program on this computer does not answer: start deepdetect app again.");
    }
    if (!response.ok) throw new UserError((await response.json()).error);
    return new Float32Array(await response.arrayBuffer());
  };
  return { run, words: "in Python on this computer" };
}

answer(tasks, (reason) => `The picture could not be worked on (${reason}): try a smaller one.`);
