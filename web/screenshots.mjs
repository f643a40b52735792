// Takes the screenshots of docs/app.md: npm run screenshots. DEEPDETECT_PYTHON is the Python to use.
import { chromium as playwright } from "@playwright/test";
import { spawn } from "node:child_process";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { PORT, chromium, example, startApp, web } from "./tests/page.mjs";

const folder = join(web, "../docs/images");
const QUALITY = 78;

const counted = (page, id, word) => page.locator(id).filter({ hasText: word }).waitFor({ timeout: 120_000 });

/** The views: the name of the file, and the steps that lead to the view. */
const VIEWS = [
  { name: "start", go: async (page) => page.locator("#examples img").last().waitFor() },
  { name: "keypoints", go: async (page) => {
    await example(page, "Coffee").click();
    await counted(page, "#count", "keypoint");
    await page.locator("input[name=kind][value=points]").check({ force: true });
    await counted(page, "#count", / points/);
  } },
  { name: "heatmap", go: (page) => page.locator("#tab-heatmap").click() },
  { name: "matches", fresh: true, go: async (page) => {
    await example(page, "Motorcycle").click();
    await counted(page, "#match-hint", "agree");
  } },
  { name: "wipe", fresh: true, go: async (page) => {
    await example(page, "Coffee, rotated").click();
    await counted(page, "#match-hint", "agree");
    await page.locator("#tab-wipe").click();
    await counted(page, "#wipe-hint", "registered");
  } },
  { name: "python", app: true, fresh: true, go: async (page) => {
    await example(page, "Motorcycle").click();
    await counted(page, "#match-hint", "agree");
    await page.locator("#tab-python").click();
    await page.locator("[data-kind=match]").click();
    await counted(page, "#job-stage", /: guided matching/);
  } },
  { name: "model", app: true, go: async (page) => {
    await page.locator("#job-progress").waitFor({ state: "hidden", timeout: 120_000 });
    await page.locator("[name=focal_px]").fill("995");
    await page.locator("[data-kind=reconstruct]").click();
    await page.frameLocator("#job-result iframe").locator("#message").waitFor({ state: "hidden", timeout: 120_000 });
    await page.locator("#job-summary").waitFor();
  } },
];

async function take(browser, address, width, height, colorScheme) {
  const pictures = [];
  const page = await browser.newPage({ viewport: { width, height }, colorScheme });
  for (const { name, go, fresh, app } of VIEWS) {
    if (fresh || !pictures.length) {
      await page.goto("about:blank");
      await page.goto(app ? address : `http://127.0.0.1:${PORT}/`);
    }
    await go(page);
    await page.locator("#busy").waitFor({ state: "hidden" });
    await page.evaluate(() => scrollTo(0, 0));
    await page.waitForTimeout(800); // until all images are drawn
    pictures.push({ name, content: await page.screenshot({ type: "jpeg", quality: QUALITY,
                                                            path: width > 500 ? join(folder, `app-${name}.jpg`) : undefined }) });
  }
  await page.close();
  return pictures;
}

const server = spawn("node", [join(web, "serve.mjs"), String(PORT)]);
const app = await startApp(process.env);
const browser = await playwright.launch({ executablePath: chromium ?? undefined,
                                          args: ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"] });
try {
  await take(browser, app.address, 1280, 800, "light");
  const narrow = await take(browser, app.address, 390, 844, "dark");
  const page = await browser.newPage({ viewport: { width: 270 * narrow.length - 10, height: 563 } });
  await page.setContent(`<body style="margin:0;display:flex;gap:10px;background:#888">${narrow.map(
    ({ content }) => `<img width="260" src="data:image/jpeg;base64,${content.toString("base64")}">`).join("")}`);
  await page.waitForTimeout(500);
  await page.screenshot({ type: "jpeg", quality: 72, path: join(folder, "app-phone.jpg") });
  for (const name of [...VIEWS.map((view) => view.name), "phone"]) {
    const kb = readFileSync(join(folder, `app-${name}.jpg`)).length / 1000;
    console.log(`app-${name}.jpg: ${kb.toFixed(0)} kB`);
  }
} finally {
  await browser.close();
  await app.end();
  server.kill();
}
