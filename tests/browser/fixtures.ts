import { execFileSync } from "node:child_process";
import { cpSync, existsSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { test as base, expect, type Page } from "@playwright/test";
import { MockDaemon, RealDaemon, type Daemon } from "./daemon";

/** Sessions named as the mock has them. */
export const FIRST = "smile";
export const SECOND = "smile-coarse";

/** A short session of the simulated scanner, and its scans coded once more with a coarser tolerance; made once. */
function recorded(): Record<string, string> {
  const folder = join(tmpdir(), `gv3-browser-demo-${process.pid}`);
  const made = { [FIRST]: join(folder, "demo.gv3"), [SECOND]: join(folder, "coarse.gv3") };
  if (existsSync(folder)) return made;
  process.on("exit", () => rmSync(folder, { recursive: true, force: true }));
  const gv3 = (...args: string[]) => execFileSync(process.env["GV3_BIN"] ?? "gv3", args, { stdio: "pipe" });
  const scans = join(folder, "scans");
  gv3("demo", "--seconds", "1", "--out", folder);
  gv3("decode", made[FIRST]!, "--format", "ply", "--out", scans);
  gv3("encode", scans, "--tolerance-mm", "0.5", "--out", made[SECOND]!);
  return made;
}

/** A daemon a file of tests, with two sessions, and pages that report their own faults. */
export const test = base.extend<{ faults: string[] }, { daemon: Daemon }>({
  daemon: [
    async ({}, use, info) => {
      const daemon: Daemon = info.project.name === "mock" ? await new MockDaemon().start() : await realWithSessions();
      await use(daemon);
      await daemon.stop();
    },
    { scope: "worker", timeout: 300_000 },
  ],
  faults: [
    async ({ page }, use) => {
      const faults: string[] = [];
      page.on("pageerror", (error) => faults.push(error.message));
      page.on("console", (message) => {
        const text = message.text();
        // What the network refuses is told in the page, and tested there.
        if (message.type() === "error" && !/Failed to load resource|WebSocket connection/.test(text)) faults.push(text);
      });
      await use(faults);
      expect(faults).toEqual([]);
    },
    { auto: true },
  ],
});

async function realWithSessions(): Promise<RealDaemon> {
  const daemon = new RealDaemon();
  for (const [name, path] of Object.entries(recorded())) cpSync(path, join(daemon.folder, `${name}.gv3`));
  return daemon.start();
}

export { expect };

/** Opens a view. */
export async function open(page: Page, daemon: Daemon, hash: string): Promise<void> {
  await page.goto("about:blank");
  await page.goto(`${daemon.url}${hash}`);
  await expect(page.locator("main")).toBeVisible();
}

/** Share of a canvas's pixels that differ from its corner: whether something is drawn there. */
export async function drawnShare(page: Page, selector: string): Promise<number> {
  const png = await page.locator(selector).first().screenshot();
  return page.evaluate(async (base64) => {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([bytes]));
    const canvas = new OffscreenCanvas(picture.width, picture.height);
    const context = canvas.getContext("2d")!;
    context.drawImage(picture, 0, 0);
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    // The corner itself may lie under the focus ring.
    const corner = 4 * (20 * canvas.width + 20);
    let different = 0;
    for (let k = 0; k < data.length; k += 4) {
      const distance = [0, 1, 2].reduce((sum, c) => sum + Math.abs(data[k + c]! - data[corner + c]!), 0);
      if (distance > 24) different += 1;
    }
    return different / (data.length / 4);
  }, png.toString("base64"));
}

/** Seconds that the timeline shows. */
export async function shownSeconds(page: Page): Promise<number> {
  const [minutes, seconds] = (await page.locator(".timeline-now").innerText()).split(":");
  return 60 * Number(minutes) + Number(seconds);
}
