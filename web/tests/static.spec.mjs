// The page alone, in a browser: what `npm run build` makes.
import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { NO_BROWSER, askPython, choose, chromium, downloaded, example, examples, expect, expectAccessible,
         openExample, slide, table, test, web } from "./page.mjs";

test.skip(!chromium, NO_BROWSER);

const KEYPOINTS = `
import json, sys
from deepdetect import DeepDetect
path, options = sys.argv[1], json.loads(sys.argv[2])
found = DeepDetect(backend="onnxruntime").detect(path, **options)
print(json.dumps({"xy": found.xy.tolist(), "scores": found.scores.tolist()}))
`;

/** Pixels as text: which ones, whatever their fractions. */
const pixel = ([x, y]) => `${Math.round(x)},${Math.round(y)}`;
const pixels = (rows) => rows.map(pixel);

/** Rows whose pixel is among those of others, and the rest. */
function split(rows, others) {
  const known = new Set(pixels(others));
  return [rows.filter((row) => known.has(pixel(row))), rows.filter((row) => !known.has(pixel(row)))];
}

/** Logits differ by up to 1e-4 here, so one probability at the threshold may fall on its other side. */
const ROUNDING = 2.5e-5, MOST_ROUNDED = 1;

async function chooseKeypoints(page, { kind = "dense", by = "threshold" }) {
  await choose(page, "kind", kind);
  await choose(page, "by", by);
}

const openFile = async (page, path) => {
  await page.locator("#file").setInputFiles(path);
  await expect(page.locator("#count")).toContainText("keypoint");
};

const CASES = [
  { name: "dense", controls: {}, options: {} },
  { name: "threshold", controls: {}, slider: ["threshold", 0.8], options: { threshold: 0.8 } },
  { name: "density", controls: { by: "density" }, slider: ["density", 12.5], options: { density: 0.125 } },
];

for (const file of ["coffee.jpg", "motorcycle-left.jpg", "motorcycle-right.jpg", "coffee-turned.jpg"]) {
  test(`keypoints of ${file} are those of Python`, async ({ page }) => {
    await page.goto("./");
    await openFile(page, join(examples, file));
    for (const { name, controls, slider, options } of CASES) {
      await chooseKeypoints(page, controls);
      if (slider) await slide(page, ...slider);
      const { content } = await downloaded(page, page.locator("#view-keypoints [data-download=csv]"));
      const found = table(content);
      const { xy, scores } = askPython(KEYPOINTS, join(examples, file), JSON.stringify(options));
      const expected = xy.map(([x, y], k) => [x, y, scores[k]]);
      expect(found.length, name).toBeGreaterThan(1000);
      const [here, only] = split(found, expected), [there, missing] = split(expected, found);
      expect(pixels(here), name).toEqual(pixels(there));
      there.forEach((row, k) => {
        const off = Math.max(...row.map((value, j) => Math.abs(here[k][j] - value)));
        if (off > 2e-3) throw new Error(`${name}: ${here[k]} instead of ${row}`);
      });
      const rounded = [...only, ...missing], least = scores.reduce((a, b) => Math.min(a, b));
      const allowed = ["dense", "threshold"].includes(name) ? MOST_ROUNDED : 0;
      expect(rounded.length, `${name}: ${rounded}`).toBeLessThanOrEqual(allowed);
      for (const row of rounded) expect(Math.abs(row[2] - least), `${name}: ${row}`).toBeLessThan(ROUNDING);
      if (slider) await slide(page, slider[0], slider[0] === "threshold" ? 0.5 : slider[1]);
    }
  });
}

test("a large photograph is reduced as Python reduces it", async ({ page }, info) => {
  const path = info.outputPath("large.png");
  askPython(`
import sys
from PIL import Image
image = Image.open(sys.argv[1]).convert("RGB").resize((2100, 1400), Image.Resampling.BICUBIC)
image.save(sys.argv[2], compress_level=1)
print("null")
`, join(examples, "coffee.jpg"), path);
  await page.goto("./");
  await openFile(page, path);
  await expect(page.locator("#files small")).toHaveText("2100×1400, scaled to 1736×1152");
  const { content } = await downloaded(page, page.locator("#view-keypoints [data-download=json]"));
  const found = JSON.parse(content);
  const expected = askPython(`
import json, sys, cv2
from deepdetect import DeepDetect, load_image
small = cv2.resize(load_image(sys.argv[1]), (1736, 1152), interpolation=cv2.INTER_AREA)
print(json.dumps(DeepDetect(backend="onnxruntime", resolution="native").detect(small).xy.tolist()))
`, path);
  expect(found.seen_as).toEqual([1736, 1152]);
  const places = new Set(found.keypoints.map(([x, y]) =>
    `${Math.round((x + 0.5) * 1736 / 2100 - 0.5)},${Math.round((y + 0.5) * 1152 / 1400 - 0.5)}`));
  const shared = pixels(expected).filter((place) => places.has(place)).length;
  // One pixel in ten thousand may be rounded otherwise when it is reduced, by one level of grey.
  expect(shared / Math.max(expected.length, found.keypoints.length)).toBeGreaterThan(0.9995);
});

test("a photograph that its camera has turned is upright", async ({ page }, info) => {
  const path = info.outputPath("turned.jpg");
  askPython(`
import sys
from PIL import Image
image = Image.open(sys.argv[1])
exif = image.getexif()
exif[0x0112] = 6
image.save(sys.argv[2], exif=exif, quality=95)
print("null")
`, join(examples, "coffee.jpg"), path);
  await page.goto("./");
  await openFile(page, path);
  await expect(page.locator("#files small")).toHaveText("400×600");
  const { content } = await downloaded(page, page.locator("#view-keypoints [data-download=csv]"));
  expect(pixels(table(content))).toEqual(pixels(askPython(KEYPOINTS, path, "{}").xy));
});

test("sliders answer at once, and do not run the network", async ({ page }) => {
  await openExample(page, "Coffee");
  const count = async () => Number((await page.locator("#count").textContent()).replace(/\D/g, ""));
  const dense = await count();
  await slide(page, "threshold", 0.9);
  const fewer = await count();
  expect(fewer).toBeLessThan(dense);
  await chooseKeypoints(page, { by: "density" });
  await slide(page, "density", 10);
  expect(await count()).toBe(24_000);
  expect(await page.locator("body").getAttribute("data-network-runs")).toBe("1");
  const drawn = await page.locator("#view-keypoints .overlay").evaluate((canvas) =>
    canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0));
  expect(drawn).toBe(true);
});

test("heat map and pictures are saved as PNG", async ({ page }) => {
  await openExample(page, "Coffee");
  const size = ({ content }) => [content.readUInt32BE(16), content.readUInt32BE(20)];
  const keypoints = await downloaded(page, page.locator("#view-keypoints [data-download=png]"));
  expect([keypoints.name, ...size(keypoints)]).toEqual(["coffee_keypoints.png", 600, 400]);
  await page.getByRole("tab", { name: "Heat map" }).click();
  const map = await downloaded(page, page.locator("#view-heatmap [data-download=png]"));
  expect([map.name, ...size(map)]).toEqual(["coffee_heatmap.png", 600, 400]);
});

test("matches of two views agree with the true disparity", async ({ page }) => {
  await openExample(page, "Motorcycle");
  await expect(page.locator("#match-hint")).toContainText("epipolar geometry");
  expect(await page.locator("body").getAttribute("data-network-runs")).toBe(null); // points need none
  const { name, content } = await downloaded(page, page.locator("#view-matches [data-download=csv]"));
  expect(name).toBe("motorcycle-left_motorcycle-right_matches.csv");
  const rows = table(content);
  expect(rows.length).toBeGreaterThan(500);
  // The pair is rectified: a right match stays on its row, and moves to the left.
  const right = rows.filter(([x0, y0, x1, y1]) => Math.abs(y0 - y1) < 2 && x1 <= x0 + 1).length;
  expect(right / rows.length).toBeGreaterThan(0.95);
  await slide(page, "ratio", 0.6);
  const fewer = async () => Number((await page.locator("#match-count").textContent()).replace(/\D/g, ""));
  await expect.poll(fewer).toBeLessThan(rows.length);
  const json = await downloaded(page, page.locator("#view-matches [data-download=json]"));
  expect(JSON.parse(json.content)).toMatchObject({ model: "fundamental", options: { ratio: 0.6 } });
});

test("matches of a camera that moved forward run away from one point", async ({ page }) => {
  await openExample(page, "Motorcycle, nearer");
  await expect(page.locator("#match-hint")).toContainText("epipolar geometry");
  const { content } = await downloaded(page, page.locator("#view-matches [data-download=csv]"));
  const rows = table(content);
  expect(rows.length).toBeGreaterThan(500);
  // The camera's principal point, where it moved to: tools/forward_example.py.
  const [cx, cy] = [311.193, 254.877];
  const right = rows.filter(([x0, y0, x1, y1]) => {
    const [before, after] = [Math.hypot(x0 - cx, y0 - cy), Math.hypot(x1 - cx, y1 - cy)];
    const beside = Math.abs((x0 - cx) * (y1 - cy) - (y0 - cy) * (x1 - cx)) / before;
    return beside < 2 && before - 2 < after && after < 1.2 * before + 2;
  });
  expect(right.length / rows.length).toBeGreaterThan(0.9);
});

test("SIFT in the page finds what OpenCV's finds", async ({ page }) => {
  const pair = ["coffee.jpg", "coffee-turned.jpg"].map((name) => join(examples, name));
  const opencv = askPython(`
import json, sys, cv2
found = []
for path in sys.argv[1:]:
    sift = cv2.SIFT_create(2000, enable_precise_upscale=True)
    found.append(sift.detectAndCompute(cv2.imread(path, 0), None))
(keypoints, first), (_, second) = found
matcher = cv2.BFMatcher(cv2.NORM_L2)
back = matcher.match(second, first)
good = [a for a, b in matcher.knnMatch(first, second, 2) if a.distance < 0.8 * b.distance
        and back[a.trainIdx].trainIdx == a.queryIdx]
print(json.dumps({"matches": len(good), "xy": [each.pt for each in keypoints]}))
`, ...pair);
  await openExample(page, "Coffee, rotated");
  await expect(page.locator("#match-hint")).toContainText("agree");
  await page.getByLabel("Compare with SIFT").check();
  await expect(page.locator("#sift-count")).toContainText("agree");
  const [matches, agreeing] = (await page.locator("#sift-count").textContent()).match(/\d+/g).map(Number);
  expect(Math.abs(matches / opencv.matches - 1)).toBeLessThan(0.1);
  expect(agreeing).toBeGreaterThan(0.7 * matches);
  const xy = await page.evaluate(async () => {
    const { findSift } = await import("/js/sift.js");
    const response = await fetch("examples/coffee.jpg");
    const bitmap = await createImageBitmap(await response.blob());
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    const { luma } = await import("/js/pixels.js");
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    return [...findSift(luma(data), bitmap.width, bitmap.height, 2000).xy];
  });
  expect(Math.abs(xy.length / 2 / opencv.xy.length - 1)).toBeLessThan(0.05);
  const near = opencv.xy.filter(([x, y]) => xy.some((u, k) => k % 2 === 0 && Math.hypot(u - x, xy[k + 1] - y) < 0.5));
  expect(near.length / opencv.xy.length).toBeGreaterThan(0.95);
});

test("matches are enlarged by the wheel and by keys, and the line that is pointed at stands out", async ({ page }) => {
  await openExample(page, "Motorcycle");
  await expect(page.locator("#match-hint")).toContainText("agree");
  const canvas = page.locator("#view-matches .lines");
  const ink = () => canvas.evaluate((lines) => lines.toDataURL());
  const plain = await ink();
  const first = await canvas.boundingBox();
  await slide(page, "thickness", 3);
  const thick = await ink();
  expect(thick).not.toBe(plain);
  for (let x = 0.2; await ink() === thick && x < 0.5; x += 0.01) { // some line crosses this row
    await page.mouse.move(first.x + x * first.width, first.y + 100);
    await page.waitForTimeout(100);
  }
  expect(await ink()).not.toBe(thick);
  const anchor = { x: first.x + 0.3 * first.width, y: first.y + 100 };
  await page.mouse.move(anchor.x, anchor.y);
  await page.mouse.wheel(0, -600);
  await expect.poll(async () => (await canvas.boundingBox()).width).toBeGreaterThan(2 * first.width);
  const box = await canvas.boundingBox();
  expect((anchor.x - box.x) / box.width).toBeCloseTo(0.3, 1); // what was under the pointer is there still
  await page.mouse.wheel(0, 900);
  await expect.poll(async () => (await canvas.boundingBox()).width).toBeLessThan(1.02 * first.width);
  await page.locator("#view-matches .stage").focus();
  await page.keyboard.press("+");
  expect((await canvas.boundingBox()).width).toBeGreaterThan(1.2 * first.width);
});

test("a plane seen aslant is one, as in Python", async ({ page }) => {
  const graf = join(web, "../../shared/data/oxford/graf");
  test.skip(!existsSync(graf), "needs Oxford's pictures in ../shared");
  await page.goto("./");
  await page.locator("#file").setInputFiles([1, 3].map((k) => join(graf, `img${k}.png`)));
  await expect(page.locator("#match-hint")).toContainText("agree with one homography");
  const { content } = await downloaded(page, page.locator("#view-matches [data-download=json]"));
  const { model, matches } = JSON.parse(content);
  expect(model).toBe("homography");
  const rows = readFileSync(join(graf, "H1to3p"), "utf-8").trim().split(/\s+/).map(Number);
  const right = matches.filter(([x, y, u, v]) => {
    const [a, b, c] = [0, 3, 6].map((k) => rows[k] * x + rows[k + 1] * y + rows[k + 2]);
    return Math.hypot(a / c - u, b / c - v) < 5;
  });
  expect(right.length / matches.length).toBeGreaterThan(0.85);
});

test("pictures that show different things have no geometry", async ({ page }) => {
  await page.goto("./");
  await page.locator("#file").setInputFiles([join(examples, "coffee.jpg"), join(examples, "motorcycle-left.jpg")]);
  await expect(page.locator("#match-hint")).toContainText("most may be wrong");
});

test("the wipe aligns a plane, and moves by mouse and by keys", async ({ page }) => {
  await openExample(page, "Coffee, rotated");
  await expect(page.locator("#match-hint")).toContainText("homography");
  await page.getByRole("tab", { name: "Compare" }).click();
  await expect(page.locator("#wipe-hint")).toContainText("registered");
  const second = page.locator("#view-wipe .overlay");
  await page.locator("#wipe").focus();
  await page.keyboard.press("Home");
  await expect(second).toHaveCSS("clip-path", "inset(0px 0px 0px 0%)");
  const box = await page.locator("#view-wipe .layers").boundingBox();
  await page.mouse.move(box.x + 5, box.y + 50);
  await page.mouse.down();
  await page.mouse.move(box.x + 0.75 * box.width, box.y + 60);
  await page.mouse.up();
  expect(Number(await page.locator("#wipe").inputValue())).toBeCloseTo(75, -0.5);
  const [video] = await Promise.all([page.waitForEvent("download"),
                                     page.getByRole("button", { name: "Video" }).click()]);
  expect(video.suggestedFilename()).toMatch(/^coffee_wipe\.(webm|mp4)$/);
  expect(readFileSync(await video.path()).length).toBeGreaterThan(20_000);
  // Aligned, both pictures are alike but for their light.
  const correlation = await page.locator("#view-wipe").evaluate((view) => {
    const [a, b] = [...view.querySelectorAll("canvas")].map((canvas) =>
      canvas.getContext("2d").getImageData(100, 60, 400, 280).data.filter((_, k) => k % 4 === 1));
    const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
    const [m, n] = [mean(a), mean(b)];
    let [ab, aa, bb] = [0, 0, 0];
    a.forEach((value, k) => {
      ab += (value - m) * (b[k] - n);
      aa += (value - m) ** 2;
      bb += (b[k] - n) ** 2;
    });
    return ab / Math.sqrt(aa * bb);
  });
  expect(correlation).toBeGreaterThan(0.95);
});

test("a file that is no picture is refused in one sentence", async ({ page }, info) => {
  const bad = info.outputPath("letter.jpg");
  writeFileSync(bad, "Dear browser");
  const small = info.outputPath("small.png");
  writeFileSync(small, Buffer.from("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg==", "base64"));
  await page.goto("./");
  await page.locator("#file").setInputFiles(bad);
  await expect(page.getByRole("alert")).toContainText(
    "letter.jpg is not an image that this browser can read: use JPEG or PNG.");
  await page.locator("#file").setInputFiles(small);
  await expect(page.getByRole("alert")).toContainText("small.png is 1x1 pixels");
  await page.locator("#file").setInputFiles([bad, small, bad]);
  await expect(page.getByRole("alert")).toContainText("Give at most 2 images.");
  await openFile(page, join(examples, "coffee.jpg"));
  await expect(page.locator("#error")).toBeHidden();
});

test("what belongs to two pictures is not said of one", async ({ page }, info) => {
  const plain = info.outputPath("plain.png");
  askPython("import sys, cv2, numpy; cv2.imwrite(sys.argv[1], numpy.full((90, 120), 77, 'u1')); print(0)", plain);
  await page.goto("./");
  await page.locator("#file").setInputFiles([plain, join(examples, "coffee.jpg")]);
  await expect(page.locator("#match-count")).toHaveText("0 matches");
  await expect(page.locator("#match-hint")).toHaveText("The two images have nothing similar.");
  await page.getByRole("tab", { name: "Compare" }).click();
  await expect(page.locator("#wipe-hint")).toContainText("No homography");
  await page.locator(".remove").first().click();
  await expect(page.locator("#wipe-hint")).toHaveText("");
});

test("nothing is added after starting over", async ({ page }, info) => {
  const [small, large] = [join(examples, "coffee.jpg"), info.outputPath("large.jpg")];
  askPython("import sys, cv2; cv2.imwrite(sys.argv[2], cv2.resize(cv2.imread(sys.argv[1]), (4500, 3000))); print(0)",
            small, large);
  await page.goto("./");
  await page.locator("#file").setInputFiles([small, large]); // the second one takes seconds
  await expect(page.locator("#files li")).toHaveCount(1);
  await expect(page.locator("#busy")).toContainText("Reading");
  await page.locator("#restart").click();
  await expect(page.locator("#busy")).toBeHidden(); // the second picture was read
  await expect(page.locator("#start")).toBeVisible({ timeout: 1 });
  await expect(page.locator("#files li")).toHaveCount(0);
});

test("pictures are dropped on the page", async ({ page }) => {
  await page.goto("./");
  await expect(page.locator("#examples button")).toHaveCount(4);
  const bytes = [...readFileSync(join(examples, "coffee.jpg"))];
  await page.evaluate((content) => {
    const transfer = new DataTransfer();
    transfer.items.add(new File([new Uint8Array(content)], "dropped.jpg", { type: "image/jpeg" }));
    dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));
  }, bytes);
  await expect(page.locator("#files b")).toHaveText("dropped.jpg");
  await expect(page.locator("#count")).toContainText("keypoint");
});

/** WebGPU's programs take minutes to compile and run in software, where others work beside. */
const SOFTWARE_WEBGPU_MS = 480_000;

test("the graphics card finds nearly the same keypoints", async ({ playwright, baseURL }) => {
  test.setTimeout(2 * SOFTWARE_WEBGPU_MS);
  const options = { executablePath: chromium, args: ["--enable-unsafe-webgpu", "--enable-features=Vulkan",
                                                     "--use-webgpu-adapter=swiftshader"] };
  const browser = await playwright.chromium.launch(options);
  const page = await browser.newPage({ baseURL });
  const count = async () => Number((await page.locator("#count").textContent()).replace(/\D/g, ""));
  await openExample(page, "Coffee");
  const before = await count();
  const has = await page.evaluate(async () => Boolean(await navigator.gpu?.requestAdapter()));
  test.skip(!has, "this browser has no WebGPU");
  await page.getByRole("button", { name: "Use the graphics card" }).click();
  await expect(page.locator("#engine")).toContainText("WebGPU");
  await page.locator("#restart").click();
  await example(page, "Coffee").click();
  // Until then the page may still show the number of the processor.
  await expect(page.locator("body")).toHaveAttribute("data-network-runs", "2", { timeout: SOFTWARE_WEBGPU_MS });
  await expect(page.locator("#count")).toContainText("keypoint");
  expect(Math.abs(await count() - before)).toBeLessThan(10);
  await browser.close();
});

test("two tabs at once", async ({ page, context }) => {
  const other = await context.newPage();
  await Promise.all([openExample(page, "Coffee"), openExample(other, "Motorcycle")]);
  await expect(page.locator("#count")).toContainText(/\d\d,\d{3} keypoints/);
  await expect(other.locator("#match-count")).toContainText("match");
});

test("by keys alone", async ({ page }) => {
  await page.goto("./");
  await expect(page.locator("#examples button")).toHaveCount(4);
  const reach = async (id) => {
    for (let k = 0; k < 40; k++) {
      if (await page.evaluate((wanted) => document.activeElement.matches(wanted), id)) return;
      await page.keyboard.press("Tab");
    }
    throw new Error(`${id} cannot be reached by Tab`);
  };
  await reach("#examples li:nth-child(3) button");
  await page.keyboard.press("Enter");
  await expect(page.locator("#count")).toContainText("keypoint");
  await reach("#threshold");
  const before = await page.locator("#count").textContent();
  await page.keyboard.press("ArrowRight");
  await expect(page.locator("#count")).not.toHaveText(before);
  await page.keyboard.press("Shift+Tab");
  for (let k = 0; k < 8 && !(await page.evaluate(() => document.activeElement.role === "tab" ||
       document.activeElement.getAttribute("role") === "tab")); k++) await page.keyboard.press("Shift+Tab");
  await page.keyboard.press("ArrowRight");
  await expect(page.locator("#view-heatmap")).toBeVisible();
  await expect(page.getByRole("tab", { name: "Heat map" })).toBeFocused();
});

for (const [width, colorScheme] of [[1280, "light"], [1280, "dark"], [390, "light"], [390, "dark"]]) {
  test(`every view is accessible and fits, ${width} px, ${colorScheme}`, async ({ page }) => {
    await page.setViewportSize({ width, height: 844 });
    await page.emulateMedia({ colorScheme });
    const check = async () => {
      await expectAccessible(page);
      expect(await page.evaluate(() => document.documentElement.scrollWidth)).toBeLessThanOrEqual(width);
    };
    await page.goto("./");
    await expect(page.locator("#examples button")).toHaveCount(4);
    await check();
    await example(page, "Coffee, rotated").click();
    await expect(page.locator("#match-hint")).toContainText("agree");
    for (const name of ["Keypoints", "Heat map", "Match", "Compare"]) {
      await page.getByRole("tab", { name }).click();
      if (name === "Compare") await expect(page.locator("#wipe-hint")).toContainText("registered");
      await check();
      if (name !== "Keypoints") continue;
      for (const spread of ["none", "anms"]) {
        await choose(page, "kind", "points");
        await choose(page, "spread", spread);
        await expect(page.locator("#count")).toHaveText("1,000 points");
        await check();
      }
    }
    await page.locator("#file").setInputFiles(join(examples, "coffee.jpg"));
    await expect(page.getByRole("alert")).toContainText("There are already two images");
    await check();
  });
}

test("long strips can be seen, and their matches too", async ({ page }, info) => {
  const [wide, tall] = ["wide", "tall"].map((name) => info.outputPath(`${name}.png`));
  askPython(`
import sys, cv2, numpy
coffee = cv2.imread(sys.argv[1])
cv2.imwrite(sys.argv[2], numpy.tile(coffee[200:220], (1, 7, 1)))
cv2.imwrite(sys.argv[3], numpy.tile(coffee[:, 300:320], (10, 1, 1)))
print(0)
`, join(examples, "coffee.jpg"), wide, tall);
  for (const [path, width, height] of [[wide, 4200, 20], [tall, 20, 4000]]) {
    await page.goto("./");
    await openFile(page, path);
    const box = await page.locator("#view-keypoints .picture").boundingBox();
    expect([box.width, box.height]).toEqual([width, height]);
    expect(await page.evaluate(() => document.documentElement.scrollWidth)).toBeLessThanOrEqual(1280);
  }
  await page.locator("#file").setInputFiles(tall);
  await expect(page.locator("#match-count")).toContainText("match");
  const size = await page.locator("#view-matches .lines").evaluate((canvas) => [canvas.width, canvas.height]);
  expect(size[1]).toBeGreaterThan(2000);
  expect(size[1]).toBeLessThanOrEqual(4 * 1280);
});
