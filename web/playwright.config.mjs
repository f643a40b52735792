import { defineConfig } from "@playwright/test";
import { chromium, PORT } from "./tests/page.mjs";

export default defineConfig({
  testDir: "tests",
  outputDir: "test-results",
  workers: 1, // the network uses all processors
  timeout: 180_000,
  expect: { timeout: 60_000 },
  reporter: "list",
  use: {
    baseURL: `http://127.0.0.1:${PORT}/`,
    viewport: { width: 1280, height: 800 },
    // Software rendering, because test machines have no graphics card.
    launchOptions: { executablePath: chromium ?? undefined,
                     args: ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"] },
  },
  webServer: { command: `node serve.mjs ${PORT}`, port: PORT, reuseExistingServer: false },
});
