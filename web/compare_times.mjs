// How long the network takes here and in Python, one thread each, in turns: node compare_times.mjs
// Python is that of the variable DEEPDETECT_PYTHON, or python3, with the package installed.
import { spawn } from "node:child_process";
import { readFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";
import * as ort from "onnxruntime-web";

const RUNS = 15, HEIGHT = 424, WIDTH = 640;
const weights = join(dirname(fileURLToPath(import.meta.url)),
                     "../src/deepdetect/detector/weights/default.onnx");
const PYTHON = `
import sys, time, numpy, onnxruntime
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
image = numpy.random.default_rng(0).random((1, 3, int(sys.argv[2]), int(sys.argv[3])), numpy.float32)
for line in sys.stdin:
    start = time.perf_counter()
    session.run(["probability"], {"image": image})
    print(time.perf_counter() - start, flush=True)
`;

ort.env.wasm.numThreads = 1;
const session = await ort.InferenceSession.create(await readFile(weights));
const values = Float32Array.from({ length: 3 * HEIGHT * WIDTH }, () => Math.random());
const image = new ort.Tensor("float32", values, [1, 3, HEIGHT, WIDTH]);

const python = spawn(process.env.DEEPDETECT_PYTHON ?? "python3",
                     ["-c", PYTHON, weights, String(HEIGHT), String(WIDTH)],
                     { stdio: ["pipe", "pipe", "inherit"] });
const answers = createInterface(python.stdout)[Symbol.asyncIterator]();

const here = [], there = [];
for (let run = 0; run <= RUNS; run++) {  // the first is not counted
  const start = performance.now();
  await session.run({ image });
  const seconds = (performance.now() - start) / 1000;
  python.stdin.write("run\n");
  const answer = await answers.next();
  if (answer.done) process.exit(1);  // Python has said why
  if (run > 0) {
    here.push(seconds);
    there.push(Number(answer.value));
  }
}
python.stdin.end();

const median = (times) => times.sort((a, b) => a - b)[times.length >> 1];
const ratio = median(here) / median(there);
console.log(`${WIDTH}x${HEIGHT}, one thread, ${RUNS} runs in turns: ONNX Runtime Web ` +
            `${(1000 * median(here)).toFixed(0)} ms, in Python ${(1000 * median(there)).toFixed(0)} ms ` +
            `(medians), ratio ${ratio.toFixed(2)}; of the fastest runs ${(here[0] / there[0]).toFixed(2)}`);
