// Dense keypoints of a PNG file by onnxruntime-web: node keypoints.mjs MODEL.onnx PHOTO.png
// prints "x y probability" of each pixel over the threshold (0.5, or the third word).
import { readFileSync } from "node:fs";
import * as ort from "onnxruntime-web";
import { PNG } from "pngjs";

const [model, photo, threshold = "0.5"] = process.argv.slice(2);
const end = (sentence) => {
  console.error(sentence);
  process.exit(2);
};
if (!photo || !(Number(threshold) >= 0)) {
  end("usage: node keypoints.mjs MODEL.onnx PHOTO.png [PROBABILITY]");
}
// A file that is missing or is another.
process.on("uncaughtException", (error) => end(`keypoints: ${error.message.split("\n")[0]}`));
ort.env.wasm.numThreads = 1;

// In a page: fetch the model, and take width, height and data (RGBA) from a canvas's getImageData.
const { width, height, data } = PNG.sync.read(readFileSync(photo));
const pixels = width * height;
const planes = new Float32Array(3 * pixels); // RGB from 0 to 1, one channel after the other
for (let k = 0; k < pixels; k++) {
  for (let c = 0; c < 3; c++) planes[c * pixels + k] = data[4 * k + c] / 255;
}

const session = await ort.InferenceSession.create(readFileSync(model));
const image = new ort.Tensor("float32", planes, [1, 3, height, width]); // any height and width
const { probability } = await session.run({ image });
const lines = [];
for (let k = 0; k < pixels; k++) {
  const value = probability.data[k];
  if (value > Number(threshold)) {
    lines.push(`${k % width} ${Math.floor(k / width)} ${value.toFixed(6)}\n`);
  }
}
process.stdout.write(lines.join(""));
