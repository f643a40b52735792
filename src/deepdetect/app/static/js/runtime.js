// ONNX Runtime in a worker, for files of this page.
import { UserError } from "./background.js";

const MAX_THREADS = 4;
const GZIP = [0x1f, 0x8b]; // the first bytes of such a file

/** The content of a file that the build has compressed, and that some web servers unpack themselves. */
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
 * @param {string} name of its file
 * @param {boolean} graphics
 * @returns {Promise<(inputs: Object<string, [string, ArrayLike<number>, number[]]>,
 *           outputs?: string[]) => Promise<Object<string, Float32Array>>>} runs it with the types,
 *           values and sides of its inputs
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
  if (!ort.env.wasm.wasmBinary) { // one for all models
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

/** Asks Python on this computer. @returns {Promise<Float32Array>} */
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
