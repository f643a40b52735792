// Points of all scales in the page, beside those of Python.
import { join } from "node:path";
import { NO_BROWSER, askPython, choose, chromium, downloaded, examples, expect, openExample, slide, table,
         test } from "./page.mjs";

test.skip(!chromium, NO_BROWSER);

const NUMBERS = [10, 20, 50, 100, 200, 300, 500, 750, 1000, 1500, 2000, 3000]; // by the slider's value

const POINTS = `
import json, sys
from deepdetect import PointDetector
path, options = sys.argv[1], json.loads(sys.argv[2])
found = PointDetector(**options).detect(path)
columns = zip(*found.xy.T.tolist(), *(each.tolist() for each in (found.scores, found.sizes, found.angles)))
print(json.dumps([list(row) for row in columns]))
`;

const pointsOf = (path, options) => askPython(POINTS, path, JSON.stringify(options));

/** The share of points that are within 0.05 pixels of one with the same size, score and angle. */
function shared(found, expected) {
  const same = expected.filter(([x, y, score, size, angle]) => found.some((other) => {
    const turned = Math.abs((other[4] - angle + 540) % 360 - 180);
    return Math.hypot(other[0] - x, other[1] - y) < 0.05 && Math.abs(other[3] - size) < 1e-3 * size
      && Math.abs(other[2] - score) < 2e-3 && turned < 1;
  }));
  return same.length / Math.max(expected.length, found.length);
}

const csv = async (page) => {
  const { content } = await downloaded(page, page.locator("#view-keypoints [data-download=csv]"));
  return { header: String(content).split("\n")[0], rows: table(content) };
};

const openPoints = async (page, path) => {
  await page.goto("./");
  await page.locator("#file").setInputFiles(path);
  await expect(page.locator("#files li")).toHaveCount(1);
  await choose(page, "kind", "points");
  await expect(page.locator("#count")).toContainText(" point");
};

for (const file of ["coffee.jpg", "motorcycle-left.jpg"]) {
  test(`points of ${file} are those of Python`, async ({ page }) => {
    const path = join(examples, file);
    await openPoints(page, path);
    for (const [value, spread] of [[6, "none"], [10, "none"], [6, "grid"], [6, "anms"]]) {
      await slide(page, "number", value);
      await choose(page, "spread", spread);
      await expect(page.locator("#count")).toHaveText(`${NUMBERS[value].toLocaleString("en")} points`);
      const { header, rows } = await csv(page);
      expect(header).toBe("x,y,score,size,angle");
      expect(rows.length).toBe(NUMBERS[value]);
      const expected = pointsOf(path, { max_keypoints: NUMBERS[value], spread });
      expect(shared(rows, expected), `${value} ${spread}`).toBeGreaterThanOrEqual(0.97);
    }
  });
}

// 1633x1225 is over two megapixels by less than half a row: points are looked for in all of its pixels.
for (const [width, height, least] of [[2100, 1400, 0.95], [1633, 1225, 0.98]]) {
  test(`points of a photograph of ${width}x${height} are in its own pixels, as in Python`, async ({ page }, info) => {
    const path = info.outputPath("large.png");
    askPython(`
import sys
from PIL import Image
size = int(sys.argv[3]), int(sys.argv[4])
image = Image.open(sys.argv[1]).convert("RGB").resize(size, Image.Resampling.BICUBIC)
image.save(sys.argv[2], compress_level=1)
print("null")
`, join(examples, "coffee.jpg"), path, String(width), String(height));
    await openPoints(page, path);
    await slide(page, "number", 10);
    const { content } = await downloaded(page, page.locator("#view-keypoints [data-download=json]"));
    const found = JSON.parse(content);
    expect(found).toMatchObject({ width, height, columns: ["x", "y", "score", "size", "angle"],
                                  options: { max_keypoints: 2000, spread: "none" } });
    // One pixel in ten thousand may be rounded otherwise when it is reduced, by one level of grey.
    expect(shared(found.keypoints, pointsOf(path, { max_keypoints: 2000 }))).toBeGreaterThan(least);
    const sizes = found.keypoints.map((row) => row[3]);
    const words = `${Math.min(...sizes).toFixed(1)} to ${Math.max(...sizes).toFixed(1)} pixels wide`;
    await expect(page.getByRole("img", { name: `large.png: 2,000 points, ${words}` })).toBeVisible();
  });
}

test("small, grey and plain pictures have the points of Python", async ({ page }, info) => {
  for (const [width, height, plain] of [[16, 16, false], [48, 33, false], [50, 40, true]]) {
    const path = info.outputPath(`${width}.png`);
    askPython(`
import sys, cv2, numpy
width, height, plain = map(int, sys.argv[2:])
noise = numpy.random.default_rng(0).integers(0, 256, (height, width)).astype("uint8")
cv2.imwrite(sys.argv[1], noise * numpy.uint8(1 - plain))
print(0)
`, path, String(width), String(height), String(Number(plain)));
    await openPoints(page, path);
    const expected = pointsOf(path, { max_keypoints: 1000 });
    expect(expected.length > 0).toBe(!plain);
    const { header, rows } = await csv(page);
    expect(header).toBe("x,y,score,size,angle");
    expect(rows.length).toBe(expected.length);
    if (!plain) expect(shared(rows, expected)).toBeGreaterThan(0.98);
    await expect(page.locator("#count")).toHaveText(`${expected.length} point${expected.length === 1 ? "" : "s"}`);
  }
});

test("the slider answers at once, nothing is ranked again, and no network is run", async ({ page }) => {
  await openExample(page, "Coffee");
  await choose(page, "kind", "points");
  await page.locator("#restart").click();
  await page.locator("#file").setInputFiles(join(examples, "motorcycle-left.jpg"));
  await expect(page.locator("#count")).toHaveText("1,000 points");
  const runs = await page.locator("body").getAttribute("data-points-runs");
  const best = (await csv(page)).rows;
  for (const value of [0, 4, 8]) {
    await slide(page, "number", value);
    await expect(page.locator("#count")).toHaveText(`${NUMBERS[value].toLocaleString("en")} points`,
                                                    { timeout: 1 });
    const drawn = await page.locator("#view-keypoints .overlay").evaluate((canvas) =>
      canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.some((byte) => byte > 0));
    expect(drawn).toBe(true);
  }
  await slide(page, "number", 4);
  expect((await csv(page)).rows).toEqual(best.slice(0, NUMBERS[4])); // a ranking: more are added behind
  await expect(page.locator("body")).toHaveAttribute("data-points-runs", runs);
  await expect(page.locator("body")).toHaveAttribute("data-network-runs", "1"); // of the first picture
  await choose(page, "kind", "dense");
  await expect(page.locator("#count")).toContainText("keypoint");
  await expect(page.locator("body")).toHaveAttribute("data-network-runs", "2");
});

test("points are chosen by keys, and said to those who hear the page", async ({ page }) => {
  await openExample(page, "Coffee");
  await page.getByRole("radio", { name: "Dense" }).focus();
  await page.keyboard.press("ArrowRight");
  await expect(page.getByRole("radio", { name: "Points" })).toBeChecked();
  await expect(page.locator("#count")).toHaveText("1,000 points");
  await expect(page.locator("#kind-hint")).toContainText("The network is not run");
  await expect(page.locator("#threshold-row")).toBeHidden();
  await page.keyboard.press("Tab");
  await expect(page.locator("#number")).toBeFocused();
  await page.keyboard.press("ArrowLeft");
  await expect(page.locator("#number")).toHaveAttribute("aria-valuetext", "750");
  await expect(page.locator("#count")).toHaveText("750 points");
  await expect(page.locator("#status")).toHaveText("750 points");
  await page.keyboard.press("Tab");
  await expect(page.getByRole("radio", { name: "None" })).toBeFocused();
  await page.keyboard.press("ArrowRight");
  await expect(page.locator("#spread-hint")).toContainText("each cell");
  await expect(page.getByRole("img", { name: /coffee\.jpg: 750 points, 3\.8 to 22\.7 pixels wide/ })).toBeVisible();
});

test("circles have the sizes of the points", async ({ page }) => {
  await openPoints(page, join(examples, "coffee.jpg"));
  await slide(page, "number", 0);
  const { rows } = await csv(page);
  const marked = await page.locator("#view-keypoints .overlay").evaluate((canvas, points) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const alpha = (x, y) => data[4 * (Math.round(y) * canvas.width + Math.round(x)) + 3] ?? 0;
    return points.map(([x, y, , size]) => [0, 1, 2, 3].filter((k) =>
      alpha(x + size / 2 * Math.cos(k * Math.PI / 2), y + size / 2 * Math.sin(k * Math.PI / 2)) > 0).length);
  }, rows);
  expect(Math.min(...marked)).toBeGreaterThanOrEqual(3); // of four places on each circle
});

test("descriptors of the page's own network are those of Python", async ({ page }) => {
  const expected = askPython(`
import json, sys, numpy as np
from deepdetect import PointDetector, load_image
from deepdetect.detector.points.descriptor import describe_learned
from deepdetect.features.learned import turn_descriptors
from deepdetect.io.image import luma
gray = luma(load_image(sys.argv[1]))
found = describe_learned(gray, PointDetector(500).detect(gray))
upright = turn_descriptors(found.descriptors, found.angles)
print(json.dumps({"gray": gray.ravel().tolist(), "xy": found.xy.ravel().tolist(),
                  "sizes": found.sizes.tolist(), "upright": upright.ravel().tolist()}))
`, join(examples, "coffee.jpg"));
  await page.goto("./");
  const upright = await page.evaluate(async ({ gray, xy, sizes }) => {
    const { Background } = await import("/js/background.js");
    const worker = new Background("/js/points_worker.js");
    const points = { xy: Float32Array.from(xy), sizes: Float32Array.from(sizes) };
    const values = { gray: Uint8Array.from(gray), width: 600, height: 400, points, token: null };
    return [...(await worker.call("describe", values)).upright];
  }, expected);
  expect(upright.length).toBe(500 * 64);
  expect(Math.max(...upright.map((value, k) => Math.abs(value - expected.upright[k])))).toBeLessThan(1e-3);
});

test("a turned picture is matched by points", async ({ page }, info) => {
  const path = info.outputPath("turned.png");
  askPython("import sys, cv2; cv2.imwrite(sys.argv[2], cv2.rotate(cv2.imread(sys.argv[1]), cv2.ROTATE_90_CLOCKWISE)); print(0)",
            join(examples, "coffee.jpg"), path);
  await page.goto("./");
  await page.locator("#file").setInputFiles([join(examples, "coffee.jpg"), path]);
  await expect(page.locator("#match-hint")).toContainText("homography");
  const { content } = await downloaded(page, page.locator("#view-matches [data-download=csv]"));
  const rows = table(content);
  expect(rows.length).toBeGreaterThan(1000);
  // By a quarter: (x, y) comes to (399 - y, x).
  const right = rows.filter(([x0, y0, x1, y1]) => Math.hypot(x1 - (399 - y0), y1 - x0) < 2).length;
  expect(right / rows.length).toBeGreaterThan(0.95);
});

test.describe("while points are found", () => {
  test.use({ serviceWorkers: "block" }); // it would answer instead of the route here

  /** Opens a picture, whose points are not found before the function that is returned is called. */
  const openHeld = async (page, files) => {
    let release = null;
    const held = new Promise((resolve) => { release = resolve; });
    await page.route("**/model/points.onnx", async (route) => {
      await held;
      await route.continue();
    });
    await page.goto("./");
    await page.locator("#file").setInputFiles(files);
    await expect(page.locator("#files li")).toHaveCount(files.length);
    if (files.length === 1) await choose(page, "kind", "points"); // two are matched by points
    await expect(page.locator("#busy")).toContainText("Finding points");
    return release;
  };

  test("moves of a slider are drawn once", async ({ page }) => {
    const release = await openHeld(page, [join(examples, "coffee.jpg")]);
    await expect(page.getByRole("img", { name: "coffee.jpg: no keypoints yet" })).toBeVisible();
    await page.evaluate(() => {
      const { stroke } = CanvasRenderingContext2D.prototype;
      CanvasRenderingContext2D.prototype.stroke = function (...values) {
        document.body.dataset.strokes = String(1 + Number(document.body.dataset.strokes ?? 0));
        return stroke.apply(this, values);
      };
    });
    for (let value = 0; value <= 10; value++) await slide(page, "number", value);
    release();
    await expect(page.locator("#count")).toHaveText("2,000 points");
    await expect(page.locator("#busy")).toBeHidden();
    await expect(page.locator("body")).toHaveAttribute("data-strokes", "1");
    await expect(page.locator("body")).toHaveAttribute("data-points-runs", "1");
  });

  test("a picture is removed, and another one opened: only the other one is ranked", async ({ page }) => {
    const release = await openHeld(page, [join(examples, "coffee.jpg")]);
    await page.locator(".remove").click();
    await expect(page.locator("#busy")).toBeHidden();
    await expect(page.locator("#start")).toBeVisible();
    await page.locator("#file").setInputFiles(join(examples, "motorcycle-left.jpg"));
    await expect(page.locator("#files b")).toHaveText("motorcycle-left.jpg");
    release();
    await expect(page.locator("#count")).toHaveText("1,000 points");
    await expect(page.locator("body")).toHaveAttribute("data-points-runs", "1");
    await expect(page.getByRole("img", { name: /motorcycle-left\.jpg: 1,000 points/ })).toBeVisible();
    await expect(page.locator("#error")).toBeHidden();
  });

  test("another kind is chosen", async ({ page }) => {
    const release = await openHeld(page, [join(examples, "coffee.jpg")]);
    await choose(page, "kind", "dense");
    await expect(page.locator("#count")).toContainText("keypoint");
    const dense = await page.locator("#count").textContent();
    release();
    await expect(page.locator("#busy")).toBeHidden();
    await expect(page.locator("#count")).toHaveText(dense);
  });

  test("of two pictures both are removed, and nothing more is looked for", async ({ page }) => {
    const release = await openHeld(page, [join(examples, "coffee.jpg"), join(examples, "coffee-turned.jpg")]);
    await page.locator("#restart").click();
    await expect(page.locator("#busy")).toBeHidden();
    release();
    await expect(page.locator("body")).not.toHaveAttribute("data-points-runs");
    await expect(page.locator("#match-count")).toHaveText("–");
    await expect(page.locator("#error")).toBeHidden();
  });
});

/** What the file of the matches says of how they were found. */
const matchOptions = async (page) => {
  const { content } = await downloaded(page, page.locator("#view-matches [data-download=json]"));
  const { options, matches } = JSON.parse(content);
  return { ...options, worst: 1 - Math.min(...matches.map((row) => row[4])) };
};

test("the ratio is moved while more keypoints are matched", async ({ page }) => {
  await openExample(page, "Motorcycle");
  await slide(page, "match-number", 4000);
  await slide(page, "ratio", 0.7);
  await expect(page.locator("#busy")).toBeHidden();
  await expect.poll(() => matchOptions(page)).toMatchObject({ keypoints: 4000, ratio: 0.7 });
  expect((await matchOptions(page)).worst).toBeLessThan(0.7);
});
