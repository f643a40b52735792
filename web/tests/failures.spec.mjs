// What the page says where files are missing or damaged, or the browser is too old: one sentence each.
import { writeFileSync } from "node:fs";
import { join } from "node:path";
import { gunzipSync } from "node:zlib";
import { NO_BROWSER, choose, chromium, example, examples, expect, openExample, test } from "./page.mjs";

test.skip(!chromium, NO_BROWSER);
test.use({ serviceWorkers: "block" }); // it would answer instead of the routes here

const MODEL = "**/model/points.onnx";
const PACKED = "**/*.wasm.packed";
const openCoffee = async (page) => {
  await page.goto("./");
  await example(page, "Coffee").click();
};

for (const { name, answer, said } of [
  { name: "missing", answer: { status: 404 }, said: "(model/points.onnx is missing)" },
  { name: "damaged", answer: { body: "<!doctype html>" }, said: "(" },
]) {
  test(`the file that finds points is ${name}`, async ({ page }) => {
    await page.route(MODEL, (route) => route.fulfill(answer));
    await openExample(page, "Coffee");
    await choose(page, "kind", "points");
    await expect(page.getByRole("alert")).toContainText(`The models for points could not be loaded ${said}`);
    await expect(page.locator("#busy")).toBeHidden();
    await choose(page, "kind", "dense");
    await expect(page.locator("#count")).toContainText("keypoint");
  });
}

test("points can be found once the connection is there again", async ({ page, context }) => {
  await openExample(page, "Coffee");
  await context.setOffline(true);
  await choose(page, "kind", "points");
  await expect(page.getByRole("alert")).toContainText("check the connection, and try again");
  await context.setOffline(false);
  await choose(page, "spread", "grid");
  await expect(page.locator("#count")).toHaveText("1,000 points");
});

test("a browser that unpacks nothing is too old", async ({ page }) => {
  await page.route(/(picture|points)_worker.js/, async (route) => {
    const response = await route.fetch();
    await route.fulfill({ response, body: `self.DecompressionStream = undefined;\n${await response.text()}` });
  });
  await page.goto("./");
  const sentence = "This browser is too old for ONNX Runtime: use one of 2023 or later.";
  await expect(page.getByRole("alert").locator("p")).toHaveText(sentence);
  await example(page, "Coffee").click();
  await expect(page.getByRole("alert").locator("p")).toHaveText(sentence);
  await choose(page, "kind", "points");
  await expect(page.getByRole("alert").locator("p")).toHaveText(sentence);
});

test("web servers may unpack ONNX Runtime themselves", async ({ page }) => {
  await page.route(PACKED, async (route) => {
    const response = await route.fetch();
    await route.fulfill({ response, body: gunzipSync(await response.body()) });
  });
  await openExample(page, "Coffee");
});

test("ONNX Runtime is damaged", async ({ page }) => {
  await page.route(PACKED, async (route) => {
    const response = await route.fetch();
    await route.fulfill({ response, body: (await response.body()).subarray(0, 100_000) });
  });
  await page.goto("./");
  await expect(page.getByRole("alert")).toContainText(/^The network could not be loaded \(.+\): load the page again\./);
});

test("a part of the page is missing", async ({ page }) => {
  await page.route("**/decoding.js", (route) => route.fulfill({ status: 404 }));
  await page.goto("./");
  const said = page.getByRole("alert").locator("p");
  await expect(said).toHaveText("A part of the page could not be loaded: load it again.");
  await example(page, "Coffee").click(); // what cannot answer is not waited for
  await expect(said).toHaveText("A part of the page could not be loaded: load it again.");
  await expect(page.locator("#busy")).toBeHidden();
});

test("a file that cannot be read does not hide the one before it", async ({ page }, info) => {
  const letter = info.outputPath("letter.jpg");
  writeFileSync(letter, "Dear browser");
  await page.goto("./");
  await page.locator("#file").setInputFiles([join(examples, "coffee.jpg"), letter]);
  await expect(page.locator("#count")).toContainText("keypoint");
  await expect(page.getByRole("alert")).toContainText("letter.jpg is not an image");
});

test("a picture that comes before the page is ready is taken when it is", async ({ page }) => {
  let answer;
  const asked = new Promise((resolve) => { answer = resolve; });
  await page.route("**/config.json", async (route) => {
    await asked;
    await route.continue();
  });
  await page.goto("./");
  await page.locator("#file").setInputFiles(join(examples, "coffee.jpg"));
  answer();
  await expect(page.locator("#files li")).toHaveCount(1);
});
