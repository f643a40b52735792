// Times the page on two images of 640x480, from the files to their matches, on one thread of
// WebAssembly, after everything is loaded: node time_pair.mjs [IMAGE IMAGE], after npm run build.
import { chromium as playwright } from "@playwright/test";
import { spawn } from "node:child_process";
import { once } from "node:events";
import { join } from "node:path";
import { PORT, askPython, chromium, examples, web } from "./tests/page.mjs";

const RUNS = 7;
const given = process.argv.slice(2);
const pair = given.length === 2 ? given
  : ["left", "right"].map((side) => join(examples, `motorcycle-${side}.jpg`));
const content = askPython(`
import base64, cv2, json, sys
images = [cv2.resize(cv2.imread(path), (640, 480), interpolation=cv2.INTER_AREA) for path in sys.argv[1:]]
print(json.dumps([base64.b64encode(cv2.imencode(".png", image)[1]).decode() for image in images]))
`, ...pair);
const files = content.map((text, k) => (
  { name: `${k}.png`, mimeType: "image/png", buffer: Buffer.from(text, "base64") }));

const server = spawn("node", [join(web, "serve.mjs"), String(PORT)]);
await once(server.stdout, "data");
const browser = await playwright.launch({ executablePath: chromium ?? undefined });
const page = await browser.newPage();
await page.goto(`http://127.0.0.1:${PORT}/`);
await page.locator("#examples button").first().waitFor();
const times = [];
for (let run = 0; run <= RUNS; run++) { // the first run loads everything and is not counted
  await page.locator("#file").setInputFiles(files);
  times.push(await page.evaluate(() => new Promise((resolve) => {
    const start = performance.now();
    const wait = () => (/match/.test(document.getElementById("match-count").textContent)
      ? resolve(performance.now() - start) : requestAnimationFrame(wait));
    wait();
  })));
  if (run === 0) times.length = 0;
  await page.locator("#restart").click();
}
await browser.close();
server.kill();
times.sort((a, b) => a - b);
const [median, fastest] = [times[RUNS >> 1], times[0]].map((time) => `${(time / 1000).toFixed(2)} s`);
console.log(`two images of 640x480, ${RUNS} runs: median ${median}, fastest ${fastest}`);
