// What the page keeps, so that it works without a network: the service worker.
import { cpSync, readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join } from "node:path";
import { NO_BROWSER, choose, chromium, example, expect, openExample, test, web } from "./page.mjs";

test.skip(!chromium, NO_BROWSER);

const TYPES = { ".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".mjs": "text/javascript",
                ".json": "application/json", ".svg": "image/svg+xml" };

/** Waits until the service worker has kept everything, and answers for the page. */
const isKept = (page) => page.evaluate(async () => {
  await navigator.serviceWorker.ready;
  while (!navigator.serviceWorker.controller) await new Promise((done) => setTimeout(done, 50));
});

/** Serves a folder, of which browsers may keep each file for an hour. */
async function serve(folder) {
  const server = createServer((request, response) => {
    const path = new URL(request.url, "http://localhost").pathname;
    const file = join(folder, path === "/" ? "index.html" : path);
    try {
      const content = readFileSync(file);
      response.writeHead(200, { "Content-Type": TYPES[extname(file)] ?? "application/octet-stream",
                                "Cache-Control": "max-age=3600" });
      response.end(content);
    } catch {
      response.writeHead(404).end();
    }
  });
  await new Promise((done) => server.listen(0, "127.0.0.1", done));
  return { address: `http://127.0.0.1:${server.address().port}/`, end: () => server.close() };
}

test("what other pages of the same host keep is left alone", async ({ page }) => {
  await page.goto("./icon.svg");
  await page.evaluate(() => caches.open("of another page"));
  await page.goto("./");
  await isKept(page);
  expect(await page.evaluate(() => caches.has("of another page"))).toBe(true);
});

test("it works without a network once it was open", async ({ page, context }) => {
  await page.goto("./");
  await isKept(page);
  await context.setOffline(true);
  await page.reload();
  await example(page, "Coffee").click();
  await expect(page.locator("#count")).toContainText("keypoint");
  await choose(page, "kind", "points");
  await expect(page.locator("#count")).toHaveText("1,000 points");
});

test("a new version replaces the old one, whatever the browser itself has kept", async ({ page }, info) => {
  const folder = info.outputPath("dist");
  cpSync(join(web, "dist"), folder, { recursive: true });
  const { address, end } = await serve(folder);
  try {
    await page.goto(address);
    await isKept(page);
    const kept = () => page.evaluate(() => caches.keys());
    const [old, ...others] = await kept();
    expect(others).toEqual([]);
    const change = (name, from, to) => {
      const text = readFileSync(join(folder, name), "utf-8");
      expect(text).toContain(from);
      writeFileSync(join(folder, name), text.replaceAll(from, to));
    };
    change("examples/examples.json", "Coffee, rotated", "Tea, rotated");
    change("sw.js", old.split(" ").at(-1), "another version");
    await page.reload(); // the old version, which looks for a newer one
    await expect.poll(kept).toEqual([expect.stringContaining("another version")]);
    await page.reload();
    await expect(example(page, "Tea, rotated")).toBeVisible();
    await openExample(page, "Coffee", address);
  } finally {
    end();
  }
});
