// The viewer that `reconstruct` writes as one file.
import { readFileSync, mkdtempSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { NO_BROWSER, askPython, chromium, expect, test } from "./page.mjs";

test.skip(!chromium, NO_BROWSER);

test("a model turns until it is touched, and is saved as a video", async ({ page }) => {
  const path = join(mkdtempSync(join(tmpdir(), "viewer-")), "model.html");
  askPython(`
import sys, numpy as np
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.point_cloud import save_point_cloud
rng = np.random.default_rng(0)
points = rng.uniform((-1, -1, 4), (1, 1, 5), (5000, 3))
save_point_cloud(PointCloud(points, rng.integers(0, 256, (5000, 3), np.uint8), "m"), sys.argv[1])
print(0)
`, path);
  await page.goto(pathToFileURL(path).href);
  const picture = () => page.locator("#view").screenshot();
  const before = await picture();
  await page.waitForTimeout(500);
  expect((await picture()).equals(before)).toBe(false);
  const [video] = await Promise.all([page.waitForEvent("download"),
                                     page.getByRole("button", { name: "Video" }).click()]);
  expect(video.suggestedFilename()).toMatch(/\.(webm|mp4)$/);
  expect(readFileSync(await video.path()).length).toBeGreaterThan(20_000);
  const after = await picture();
  await page.waitForTimeout(500);
  expect((await picture()).equals(after)).toBe(true);
});
