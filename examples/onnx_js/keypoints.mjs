// Keypoints of a PNG file by onnxruntime-web, with a file of `deepdetect export onnx`:
// node keypoints.mjs MODEL.onnx PHOTO.png [PROBABILITY]
// prints "x y size angle score" of the best points of all scales; with a probability "x y probability" of
// each pixel over it.
import { readFileSync } from "node:fs";
import * as ort from "onnxruntime-web";
import { PNG } from "pngjs";

const [model, photo, threshold = "0"] = process.argv.slice(2);
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
const outputs = Number(threshold) > 0 ? ["probability"] : ["keypoints", "scores", "sizes", "angles"];
const { probability, keypoints, scores, sizes, angles } = await session.run({ image }, outputs);
const lines = [];
for (let k = 0; k < (probability ?? scores).data.length; k++) {
  if (probability?.data[k] > Number(threshold)) {
    lines.push(`${k % width} ${Math.floor(k / width)} ${probability.data[k].toFixed(6)}\n`);
  } else if (scores?.data[k] > 0) { // 0 behind the last point
    const [x, y] = [keypoints.data[2 * k], keypoints.data[2 * k + 1]].map((value) => value.toFixed(3));
    const [size, angle] = [sizes, angles].map(({ data }) => data[k].toFixed(2));
    lines.push(`${x} ${y} ${size} ${angle} ${scores.data[k].toFixed(6)}\n`);
  }
}
process.stdout.write(lines.join(""));
