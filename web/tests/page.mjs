// What the tests of the page share: the browser, the server under Python, and the page's parts.
import AxeBuilder from "@axe-core/playwright";
import { test as base, expect } from "@playwright/test";
import { execFileSync, spawn } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

export const PORT = 8871;
export const web = join(dirname(fileURLToPath(import.meta.url)), "..");
export const examples = join(web, "../src/deepdetect/app/static/examples");
const python = process.env.DEEPDETECT_PYTHON ?? "python3";

// Debian's browser; Playwright's own cannot be downloaded everywhere.
export const chromium = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser",
                         "/usr/bin/google-chrome"].find((path) => path && existsSync(path)) ?? null;
export const NO_BROWSER = "needs Chromium: apt-get install chromium, or name one in CHROMIUM";

/** Runs Python; returns what it prints, which is JSON. */
export function askPython(code, ...words) {
  return JSON.parse(execFileSync(python, ["-c", code, ...words], { maxBuffer: 2 ** 28 }));
}

/** Starts deepdetect app. */
export async function startApp(env) {
  const child = spawn(python, ["-m", "deepdetect", "app", "--port", "0"],
                      { env, stdio: ["ignore", "pipe", "inherit"] });
  const ended = new Promise((resolve) => child.on("exit", resolve));
  const address = await new Promise((resolve, reject) => {
    child.stdout.on("data", (data) => {
      const found = /http:\S+/.exec(String(data));
      if (found) resolve(found[0]);
    });
    child.on("exit", (code) => reject(new Error(`deepdetect app ended with ${code}`)));
  });
  const end = () => {
    child.kill("SIGTERM");
    return ended;
  };
  return { address, end };
}

export const test = base.extend({
  // No test may ask another host, or leave an error in the console.
  page: async ({ page }, use) => {
    const seen = watch(page);
    await use(page);
    expect(seen.elsewhere).toEqual([]);
    expect(seen.errors).toEqual([]);
  },
  // deepdetect app, with a folder for temporary files that is looked at when it has ended.
  app: [async ({}, use) => {
    const folder = mkdtempSync(join(tmpdir(), "app-test-"));
    const app = await startApp({ ...process.env, TMPDIR: folder });
    await use({ address: app.address, folder });
    await app.end();
    rmSync(folder, { recursive: true });
  }, { scope: "worker" }],
});

/** Collects requests for other hosts, and errors, of a page. */
export function watch(page) {
  const seen = { elsewhere: [], errors: [] };
  page.on("request", (request) => {
    const url = new URL(request.url());
    if (url.protocol.startsWith("http") && url.hostname !== "127.0.0.1") seen.elsewhere.push(url.href);
  });
  page.on("pageerror", (error) => seen.errors.push(error.message));
  page.on("console", (message) => {
    const expected = /status of 40\d/; // refusals that a test provokes; the page says them itself
    if (message.type() === "error" && !expected.test(message.text())) seen.errors.push(message.text());
  });
  return seen;
}

/** Rows of numbers of a CSV file. */
export const table = (content) =>
  String(content).trim().split("\n").slice(1).map((line) => line.split(",").map(Number));

/** Chooses one of the buttons of a group. */
export const choose = (page, name, value) =>
  page.locator(`input[name=${name}][value=${value}]`).check({ force: true });

export const example = (page, title) =>
  page.locator("#examples button").filter({ has: page.locator(`span:text-is("${title}")`) });

/** Opens an example and waits for its keypoints or matches. */
export async function openExample(page, title, address = "./") {
  await page.goto(address);
  await example(page, title).click();
  if (title === "Coffee") await expect(page.locator("#count")).toContainText("keypoint");
  else await expect(page.locator("#match-count")).toContainText("match");
}

/** The text of the file that a click downloads. */
export async function downloaded(page, button) {
  const [download] = await Promise.all([page.waitForEvent("download"), button.click()]);
  return { name: download.suggestedFilename(), content: readFileSync(await download.path()) };
}

/** Moves a slider to a value, as a user does: by events. */
export async function slide(page, id, value) {
  await page.locator(`#${id}`).evaluate((input, to) => {
    input.value = String(to);
    input.dispatchEvent(new Event("input", { bubbles: true }));
    input.dispatchEvent(new Event("change", { bubbles: true }));
  }, value);
  await page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));
}

export async function expectAccessible(page) {
  const { violations } = await new AxeBuilder({ page }).analyze();
  expect(violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.html).join(" | ")}`)).toEqual([]);
}

export { expect };
