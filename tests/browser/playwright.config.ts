import { defineConfig } from "@playwright/test";

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
  expect: { timeout: 60_000 },
  reporter: [["list"]],
  use,
  projects: [
    { name: "gv3", testMatch: /.*\.spec\.ts/, testIgnore: /mock\.spec\.ts/ },
    { name: "mock", testMatch: /.*\.spec\.ts/, testIgnore: /gv3\.spec\.ts/ },
    // Figures, which a machine that does other things too may miss: only when they are asked for.
    ...(process.env["GV3_MEASURE_MINUTES"] ? [{ name: "measure", testMatch: /measure\.ts/ }] : []),
  ],
});
