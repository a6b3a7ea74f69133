import { defineConfig } from "@playwright/test";

/** What every change must pass: each test once, against the daemon if it can be, and within this time. */
const isShort = !!process.env["GV3_BROWSER_SHORT"];
const SHORT_MS = 240_000;

const use = {
  launchOptions: {
    executablePath: process.env["GV3_CHROMIUM"] ?? "/usr/bin/chromium",
    // WebGL in software, as on a machine without a graphics card; a container has no user namespaces for the sandbox.
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  },
  viewport: { width: 1280, height: 800 },
  acceptDownloads: true,
};

export default defineConfig({
  testDir: ".",
  outputDir: "results",
  // One at a time: a daemon, a simulated scanner and a browser share the machine.
  workers: 1,
  timeout: 240_000,
  globalTimeout: isShort ? SHORT_MS : 0,
  expect: { timeout: 60_000 },
  reporter: [["list"]],
  use,
  projects: [
    {
      name: "gv3",
      testMatch: /.*\.spec\.ts/,
      testIgnore: isShort ? /(mock|accessibility)\.spec\.ts/ : /mock\.spec\.ts/,
    },
    {
      name: "mock",
      testMatch: isShort ? /(mock|accessibility)\.spec\.ts/ : /.*\.spec\.ts/,
      testIgnore: /gv3\.spec\.ts/,
    },
    // Figures, which a machine that does other things too may miss: only when they are asked for.
    ...(process.env["GV3_MEASURE_MINUTES"] ? [{ name: "measure", testMatch: /measure\.ts/ }] : []),
  ],
});
