// The page with Python: `deepdetect app`.
import { cpSync, mkdirSync, readdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { NO_BROWSER, askPython, choose, chromium, downloaded, example, examples, expect, expectAccessible,
         openExample, table, test, watch } from "./page.mjs";

test.skip(!chromium, NO_BROWSER);

/** The folders of tasks that are there. */
const tasksOf = ({ folder }) => readdirSync(folder).filter((name) => name.startsWith("deepdetect-app-"))
  .flatMap((name) => readdirSync(join(folder, name)));

const openTasks = async (page, title, app) => {
  await openExample(page, title, app.address);
  await page.getByRole("tab", { name: "3D, panorama, folder" }).click();
};

const startTask = (page, kind) => page.locator(`[data-kind="${kind}"]`).click();

test("it says what it can, and finds the keypoints of Python", async ({ page, app }) => {
  await openExample(page, "Coffee", app.address);
  await expect(page.locator("#power")).toHaveText("With Python");
  expect(page.url()).not.toContain("key");
  const { content } = await downloaded(page, page.locator("#view-keypoints [data-download=csv]"));
  const expected = askPython(`
import json, sys
from deepdetect import DeepDetect
print(json.dumps(DeepDetect().detect(sys.argv[1]).xy.tolist()))
`, join(examples, "coffee.jpg"));
  expect(table(content).map((row) => row.slice(0, 2))).toEqual(expected);
  await choose(page, "kind", "points");
  await expect(page.locator("#count")).toHaveText("1,000 points");
  const points = await downloaded(page, page.locator("#view-keypoints [data-download=csv]"));
  expect(String(points.content).split("\n")[0]).toBe("x,y,score,size,angle");
});

test("guided matching finds many times as many, and nothing is kept", async ({ page, app }) => {
  await openTasks(page, "Motorcycle", app);
  const alone = Number((await page.locator("#match-count").textContent()).replace(/\D/g, ""));
  await startTask(page, "match");
  await expect(page.locator("#job-cancel")).toBeFocused();
  await expect(page.locator("#job-result img")).toBeVisible({ timeout: 120_000 });
  await expect(page.locator("[data-kind=match]")).toBeFocused();
  const matches = Number(/Matches([\d,]+)/.exec(await page.locator("#job-numbers").textContent())[1].replaceAll(",", ""));
  expect(matches).toBeGreaterThan(20 * alone);
  await expect.poll(() => tasksOf(app)).toEqual([]);
  const { name, content } = await downloaded(page, page.getByRole("button", { name: "matches.csv" }));
  expect(name).toBe("matches.csv");
  expect(String(content).split("\n").length).toBe(matches + 2);
  await expectAccessible(page);
});

test("a 3D model is shown, and can be turned", async ({ page, app }) => {
  await openTasks(page, "Motorcycle", app);
  await startTask(page, "reconstruct");
  await expect(page.locator("#job-numbers")).toContainText("assumed", { timeout: 120_000 });
  await page.locator("[name=focal_px]").fill("995");
  const framed = page.waitForResponse((response) => response.url().endsWith("/model.html")
    && response.request().isNavigationRequest());
  await startTask(page, "reconstruct");
  const policy = (await framed).headers()["content-security-policy"];
  expect(policy).toContain("default-src 'none'");
  expect(policy).toContain("sandbox allow-scripts");
  expect(policy).not.toContain("connect-src");
  const viewer = page.frameLocator("#job-result iframe");
  await expect(viewer.locator("#message")).toBeHidden({ timeout: 120_000 });
  await expect(viewer.locator("dl")).toContainText("Points");
  const frame = page.locator("#job-result iframe");
  const opened = await frame.screenshot();
  await expect.poll(async () => (await frame.screenshot()).equals(opened)).toBe(false); // it sways
  const box = await frame.boundingBox();
  await page.mouse.move(box.x + 500, box.y + 100);
  await page.mouse.down();
  let touched = null;
  await expect.poll(async () => {
    touched = await frame.screenshot();
    await page.waitForTimeout(500);
    return (await frame.screenshot()).equals(touched);
  }).toBe(true);
  await page.mouse.move(box.x + 300, box.y + 100);
  await page.mouse.up();
  await expect.poll(async () => (await frame.screenshot()).equals(touched)).toBe(false);
  await expect.poll(() => tasksOf(app)).toEqual([]);
  const { content } = await downloaded(page, page.getByRole("button", { name: "model.ply" }));
  expect(String(content.subarray(0, 3))).toBe("ply");
  await expectAccessible(page);
});

test("registration is compared in the wipe", async ({ page, app }) => {
  await openTasks(page, "Coffee, rotated", app);
  await startTask(page, "register");
  await page.getByRole("button", { name: "Compare with the first" }).click({ timeout: 120_000 });
  await expect(page.locator("#wipe-hint")).toContainText("guided matching");
});

test("a panorama", async ({ page, app }) => {
  await openTasks(page, "Coffee, rotated", app);
  await startTask(page, "stitch");
  await expect(page.locator("#job-numbers")).toContainText("2 of 2", { timeout: 120_000 });
  const { name, content } = await downloaded(page, page.getByRole("button", { name: "panorama.jpg" }));
  expect(name).toBe("panorama.jpg");
  expect(content.subarray(0, 2)).toEqual(Buffer.from([0xff, 0xd8]));
});

test("a task is cancelled", async ({ page, app }) => {
  await openTasks(page, "Motorcycle", app);
  await startTask(page, "match");
  await expect.poll(() => tasksOf(app).length).toBe(1);
  await page.locator("#job-cancel").click();
  await expect(page.locator("#job-progress")).toBeHidden();
  await expect.poll(() => tasksOf(app)).toEqual([]);
  await expect(page.locator("[data-kind=match]")).toBeEnabled();
  await expect(page.locator("#error")).toBeHidden();
});

test("a task can follow a cancelled one at once", async ({ page, app }) => {
  await openTasks(page, "Coffee, rotated", app);
  for (let k = 0; k < 2; k++) {
    await startTask(page, "match");
    await expect.poll(() => tasksOf(app).length).toBe(1);
    await page.locator("#job-cancel").click();
  }
  await startTask(page, "register");
  await expect(page.locator("#job-numbers")).toContainText("Overlap", { timeout: 120_000 });
  await expect(page.locator("#error")).toBeHidden();
  await expect.poll(() => tasksOf(app)).toEqual([]);
});

test("a task that is cancelled while its result is fetched says nothing", async ({ page, app }) => {
  let answer = () => {};
  const held = new Promise((resolve) => { answer = resolve; });
  await page.route("**/files/registered.png", async (route) => {
    await held;
    await route.continue();
  });
  await openTasks(page, "Coffee, rotated", app);
  const asked = page.waitForRequest("**/files/registered.png", { timeout: 120_000 });
  await startTask(page, "register");
  await asked;
  await page.locator("#job-cancel").click();
  answer();
  await expect.poll(() => tasksOf(app)).toEqual([]);
  await page.waitForTimeout(500);
  await expect(page.locator("#error")).toBeHidden();
  await expect(page.locator("#job-result")).toBeHidden();
});

test("a task ends with the pictures that it was for", async ({ page, app }) => {
  await openTasks(page, "Coffee, rotated", app);
  await startTask(page, "register");
  await expect.poll(() => tasksOf(app).length).toBe(1);
  await page.locator(".remove").first().click();
  await expect.poll(() => tasksOf(app)).toEqual([]);
  await expect(page.locator("#job-progress")).toBeHidden();
  await expect(page.locator("#job-empty")).toBeVisible();
});

test("the address of a new start is taken where the page is open", async ({ page, app }) => {
  await page.goto(app.address.replace(/key=.*/, "key=old"));
  await expect(page.locator("#examples button").first()).toBeVisible();
  await example(page, "Coffee").click();
  await expect(page.getByRole("alert")).toContainText("key of this page is wrong");
  await page.goto(app.address); // the browser only changes what follows the #
  await expect(page.locator("#error")).toBeHidden();
  await example(page, "Coffee").click();
  await expect(page.locator("#count")).toContainText("keypoint");
});

test("leaving the page ends its task", async ({ context, app }) => {
  const page = await context.newPage();
  await openTasks(page, "Motorcycle", app);
  await startTask(page, "match");
  await expect(page.locator("#job-stage")).not.toContainText("sending");
  expect(tasksOf(app).length).toBe(1);
  await page.goto("about:blank");
  await expect.poll(() => tasksOf(app)).toEqual([]);
  await page.close();
});

test("a folder", async ({ page, app }, info) => {
  const folder = info.outputPath("photos");
  mkdirSync(folder);
  for (const name of ["coffee.jpg", "motorcycle-left.jpg"]) cpSync(join(examples, name), join(folder, name));
  writeFileSync(join(folder, "damaged.png"), "no picture");
  writeFileSync(join(folder, "notes.txt"), "not asked for");
  await page.goto(app.address);
  await page.getByRole("button", { name: "Process a folder" }).click();
  await page.locator("[data-kind=folder-keypoints]").click();
  await page.locator("#folder").setInputFiles(folder);
  await expect(page.locator("#job-numbers")).toContainText("2 of 3", { timeout: 120_000 });
  await expect(page.locator("#job-numbers")).toContainText("4,096");
  const { content } = await downloaded(page, page.getByRole("button", { name: "keypoints.zip" }));
  for (const name of ["coffee.csv", "motorcycle-left.csv", "failures.txt"]) expect(content.includes(name)).toBe(true);
});

test("what has no geometry is said in one sentence", async ({ page, app }) => {
  await page.goto(app.address);
  await page.locator("#file").setInputFiles([join(examples, "coffee.jpg"), join(examples, "motorcycle-left.jpg")]);
  await page.getByRole("tab", { name: "3D, panorama, folder" }).click();
  await startTask(page, "register");
  await expect(page.getByRole("alert")).toContainText("No homography can be trusted", { timeout: 120_000 });
});

test("two tabs at once, each with its own task", async ({ page, context, app }) => {
  const other = await context.newPage();
  const seen = watch(other);
  await openTasks(page, "Coffee, rotated", app);
  await openTasks(other, "Coffee, rotated", app);
  await Promise.all([startTask(page, "register"), startTask(other, "match")]);
  await expect(page.locator("#job-numbers")).toContainText("Overlap", { timeout: 150_000 });
  await expect(other.locator("#job-numbers")).toContainText("homography", { timeout: 150_000 });
  expect(seen).toEqual({ elsewhere: [], errors: [] });
});

test("without the key of this start nothing is answered", async ({ page, app }) => {
  await page.goto(app.address.replace(/#.*/, ""));
  await expect(page.getByRole("alert")).toContainText("Open the address that deepdetect app printed");
  const status = await page.evaluate(async () => (await fetch("/api/jobs?kind=match", { method: "POST", body: "x" })).status);
  expect(status).toBe(401);
});

for (const width of [1280, 390]) {
  test(`the tasks are accessible and fit, ${width} px`, async ({ page, app }) => {
    await page.setViewportSize({ width, height: 844 });
    await openTasks(page, "Coffee, rotated", app);
    await expectAccessible(page);
    await startTask(page, "register");
    await expect(page.locator("#job-progress")).toBeVisible();
    await expectAccessible(page);
    await expect(page.locator("#job-numbers")).toContainText("Overlap", { timeout: 120_000 });
    await expectAccessible(page);
    expect(await page.evaluate(() => document.documentElement.scrollWidth)).toBeLessThanOrEqual(width);
  });
}
