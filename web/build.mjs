// Builds web/dist: the page with ONNX Runtime, the networks and the graph of the points, for any web server.
import { createHash } from "node:crypto";
import { cpSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { basename, dirname, join, relative } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

const here = dirname(fileURLToPath(import.meta.url));
const dist = join(here, "dist");
const packaged = join(here, "../src/deepdetect");
const runtime = join(here, "node_modules/onnxruntime-web/dist");

// The second list is loaded with WebGPU only.
const RUNTIME_FILES = ["ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm"];
const WEBGPU_FILES = ["ort.webgpu.min.mjs", "ort-wasm-simd-threaded.asyncify.mjs",
                      "ort-wasm-simd-threaded.asyncify.wasm"];

rmSync(dist, { recursive: true, force: true });
cpSync(join(packaged, "app/static"), dist, { recursive: true });
mkdirSync(join(dist, "ort"));
// Not every web server compresses WebAssembly and models, so the page unpacks them itself. Servers do
// not know these file endings and serve the files unchanged.
const packedName = (name) => name.replace(/\.wasm$/, ".wasm.packed");
for (const name of [...RUNTIME_FILES, ...WEBGPU_FILES]) {
  const content = readFileSync(join(runtime, name));
  writeFileSync(join(dist, "ort", packedName(name)),
                name.endsWith(".wasm") ? gzipSync(content, { level: 9 }) : content);
}
mkdirSync(join(dist, "model"));
for (const path of [join(packaged, "detector/weights/default.onnx"), join(here, "points.onnx"),
                    join(packaged, "detector/points/descriptor.onnx")]) {
  writeFileSync(join(dist, "model", basename(path)), gzipSync(readFileSync(path), { level: 9 }));
}
writeFileSync(join(dist, "config.json"),
              JSON.stringify({ engine: "browser", offline: true, webgpu: true }) + "\n");

const files = readdirSync(dist, { recursive: true, withFileTypes: true })
  .filter((entry) => entry.isFile())
  .map((entry) => relative(dist, join(entry.parentPath, entry.name)).replaceAll("\\", "/"))
  .sort();
const webgpu = WEBGPU_FILES.map((name) => `ort/${packedName(name)}`);
const kept = files.filter((name) => !webgpu.includes(name));
const digest = createHash("sha256");
for (const name of kept) digest.update(name).update(readFileSync(join(dist, name)));
const worker = readFileSync(join(here, "sw.js"), "utf-8")
  .replace('"VERSION"', JSON.stringify(digest.digest("hex").slice(0, 16)))
  .replace('["FILES"]', JSON.stringify(["./", ...kept]));
writeFileSync(join(dist, "sw.js"), worker);

const bytes = (names) => names.reduce((sum, name) => sum + readFileSync(join(dist, name)).length, 0);
console.log(`web/dist: ${(bytes(kept) / 1e6).toFixed(1)} MB, and ${
  (bytes(files.filter((name) => !kept.includes(name))) / 1e6).toFixed(1)} MB for WebGPU`);
