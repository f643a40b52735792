// ONNX Runtime in a worker, for the models of this page; and requests to Python.
import { UserError } from "./background.js";

const MAX_THREADS = 4;
const GZIP = [0x1f, 0x8b]; // first bytes of a gzip file

/** Returns the contents of a file that the build has compressed, unless the web server unpacks it. */
async function unpacked(response) {
  const content = await response.arrayBuffer();
  const [first, second] = new Uint8Array(content);
  if (first !== GZIP[0] || second !== GZIP[1]) return content;
  if (typeof DecompressionStream === "undefined") {
    throw new UserError("This browser is too old for ONNX Runtime: use one of 2023 or later.");
  }
  return new Response(new Blob([content]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/**
 * Opens a model, on the processor (WebAssembly) or on the graphics card (WebGPU).
 *
 * @param {string} name name of its file
 * @param {boolean} graphics whether to use the graphics card
 * @returns {Promise<(inputs: Object<string, [string, ArrayLike<number>, number[]]>,
 *           outputs?: string[]) => Promise<Object<string, Float32Array>>>} a function that runs the
 *           model, given types, values and shapes of its inputs
 */
export async function openModel(name, graphics = false) {
  const response = await fetch(new URL(`../model/${name}`, import.meta.url)).catch(() => {
    throw new UserError(`model/${name} could not be loaded: check the connection, and try again.`);
  });
  if (!response.ok) throw new Error(`model/${name} is missing`);
  const content = await unpacked(response);
  const folder = new URL("../ort/", import.meta.url).href;
  const ort = await import(`${folder}ort.${graphics ? "webgpu" : "wasm"}.min.mjs`);
  ort.env.logLevel = "error";
  ort.env.wasm.wasmPaths = folder;
  if (!ort.env.wasm.wasmBinary) { // shared by all models
    const binary = await fetch(`${folder}ort-wasm-simd-threaded.${graphics ? "asyncify." : ""}wasm.packed`);
    if (!binary.ok) throw new Error("a file of ONNX Runtime is missing");
    ort.env.wasm.wasmBinary = await unpacked(binary);
  }
  ort.env.wasm.numThreads = self.crossOriginIsolated
    ? Math.min(MAX_THREADS, navigator.hardwareConcurrency || 1) : 1;
  const session = await ort.InferenceSession.create(
    content, { executionProviders: [graphics ? "webgpu" : "wasm"] });
  return async (inputs, outputs) => {
    const feeds = Object.entries(inputs).map(([key, values]) => [key, new ort.Tensor(...values)]);
    const found = await session.run(Object.fromEntries(feeds), outputs);
    return Object.fromEntries(Object.entries(found).map(([key, { data: values }]) => [key, values]));
  };
}

/** Sends a request to Python on this computer. @returns {Promise<Float32Array>} */
export async function askPython(task, width, height, body, token) {
  let response;
  try {
    response = await fetch(`/api/${task}?width=${width}&height=${height}`, {
      method: "POST", body,
      headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/octet-stream" },
    });
  } catch {
    throw new UserError("The program on this computer does not answer: start deepdetect app again.");
  }
  if (!response.ok) throw new UserError((await response.json()).error);
  return new Float32Array(await response.arrayBuffer());
}
