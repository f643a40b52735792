// Reads pictures and runs the network, beside the page: by ONNX Runtime here, or by Python.
import { MIN_SIDE, isConstant, networkSize, reduceByArea, toPlanes } from "./pixels.js";
import { prepare } from "./selection.js";

const MAX_FILE_MB = 100;
const MAX_MEGAPIXELS = 100;
const MAX_THREADS = 4;

/** What the page may say to the user, unlike errors of the program. */
class UserError extends Error {}

let runNetwork = null;

const tasks = {
  /** Opens the network. @returns {Promise<string>} what runs it, in words */
  async open({ engine, token, processor }) {
    const opened = engine === "python" ? pythonNetwork(token) : await browserNetwork(processor);
    runNetwork = opened.run;
    return opened.words;
  },

  /** Decodes a file, upright, and reduces it to the size at which the network sees it. */
  async read({ file, name }) {
    if (file.size > MAX_FILE_MB * 1e6) {
      throw new UserError(`${name} is over ${MAX_FILE_MB} MB: use a smaller picture.`);
    }
    let bitmap;
    try {
      bitmap = await createImageBitmap(file, { imageOrientation: "from-image",
                                               colorSpaceConversion: "none" });
    } catch {
      throw new UserError(`${name} is not a picture that this browser can read: use JPEG or PNG.`);
    }
    try {
      return pixelsOf(bitmap, name);
    } finally {
      bitmap.close();
    }
  },

  /** Computes the heat map of pixels that `read` returned. */
  async run({ rgba, width, height }) {
    const started = performance.now();
    const logits = isConstant(rgba) ? new Float32Array(width * height).fill(-Infinity)
                                    : await runNetwork(rgba, width, height);
    const seconds = (performance.now() - started) / 1000;
    return { map: prepare(logits, width, height), seconds };
  },
};

function pixelsOf(bitmap, name) {
  const { width, height } = bitmap;
  if (Math.min(width, height) < MIN_SIDE) {
    throw new UserError(`${name} is ${width}x${height} pixels: both sides must be at least `
                        + `${MIN_SIDE}, use a larger picture.`);
  }
  if (width * height > MAX_MEGAPIXELS * 1e6) {
    throw new UserError(`${name} has over ${MAX_MEGAPIXELS} megapixels: use a smaller picture.`);
  }
  const [newWidth, newHeight] = networkSize(width, height);
  const readRows = (top, rows) => {
    const canvas = new OffscreenCanvas(width, rows); // small: phones limit the size of a canvas
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(bitmap, 0, -top);
    return context.getImageData(0, 0, width, rows).data;
  };
  const reduced = width !== newWidth || height !== newHeight;
  const rgba = reduced ? reduceByArea(readRows, width, height, newWidth, newHeight)
                       : readRows(0, height);
  return { rgba, width: newWidth, height: newHeight, original: { width, height } };
}

async function browserNetwork(processor) {
  const folder = new URL("../ort/", import.meta.url).href;
  const graphics = processor === "graphics";
  const ort = await import(`${folder}ort.${graphics ? "webgpu" : "wasm"}.min.mjs`);
  ort.env.logLevel = "error";
  ort.env.wasm.wasmPaths = folder;
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

self.onmessage = async ({ data: { id, task, values } }) => {
  try {
    self.postMessage({ id, result: await tasks[task](values) });
  } catch (error) {
    const said = error instanceof UserError ? error.message
      : `The picture could not be worked on (${error.message}): try a smaller one.`;
    self.postMessage({ id, error: said });
  }
};
