import { existsSync, mkdtempSync, readFileSync, rmSync, statfsSync, writeFileSync } from "node:fs";
import { execFileSync } from "node:child_process";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { RealDaemon } from "./daemon";
import { drawnShare, expect, open, test } from "./fixtures";

const RIG = join(__dirname, "../../config/simulated.toml");
/** A disk that others rarely write to. */
const MEMORY_DISK = "/dev/shm";

test("a token is asked for, and a wrong one refused in words", async ({ page }) => {
  const folder = mkdtempSync(join(tmpdir(), "gv3-token-"));
  const path = join(folder, "token");
  execFileSync(process.env["GV3_BIN"] ?? "gv3", ["serve", "--new-token", path]);
  const daemon = await new RealDaemon(["--sim", "--token-file", path]).start();
  await page.goto(daemon.url);
  await page.getByLabel("Token").fill("wrong");
  await page.getByRole("button", { name: "Log in" }).click();
  await expect(page.getByText("That token is not right")).toBeVisible();
  await page.getByLabel("Token").fill(readFileSync(path, "utf8").trim());
  await page.getByRole("button", { name: "Log in" }).click();
  await expect(page.getByRole("dialog")).toBeHidden();
  await expect(page.locator(".pill")).toHaveText("idle");
  await daemon.stop();
  rmSync(folder, { recursive: true });
});

test("a disk that fills up ends the recording, and no other begins, in words", async ({ page }) => {
  test.skip(!existsSync(MEMORY_DISK), `there is no ${MEMORY_DISK} to fill`);
  const folder = mkdtempSync(join(MEMORY_DISK, "gv3-full-"));
  const rig = join(folder, "rig.toml");
  const { bavail, bsize } = statfsSync(folder);
  const floor = bavail * bsize - (64 << 20);
  writeFileSync(
    rig,
    `${readFileSync(RIG, "utf8")}\n[sessions]\nfree_floor_bytes = ${floor}\nfree_floor_percent = 0.0\n`,
  );
  const daemon = await new RealDaemon(["--config", rig], join(folder, "sessions")).start();
  await page.goto(daemon.url);
  await page.getByLabel("Name of the next recording").fill("until-full");
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.locator(".state")).toHaveText("Recording");
  await page.waitForTimeout(1000);
  writeFileSync(join(folder, "filler"), Buffer.alloc(128 << 20));
  await expect(page.getByRole("alert").filter({ hasText: "are free" }).first()).toBeVisible();
  await expect(page.locator(".state")).not.toHaveText("Recording");
  await expect(page.getByText("below the floor")).toBeVisible();
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.getByRole("alert").filter({ hasText: "lower the floor" }).last()).toBeVisible();
  await page.keyboard.press("s");
  await expect(page.getByRole("row").filter({ hasText: "until-full" }).locator(".badge")).toHaveText("complete");
  await daemon.stop();
  rmSync(folder, { recursive: true });
});

test("a camera unplugged during a recording is told, and the recording goes on when it is back", async ({ page }) => {
  const folder = mkdtempSync(join(tmpdir(), "gv3-unplugged-"));
  const rig = join(folder, "rig.toml");
  const fault = '[[sim.faults]]\nkind = "unplugged"\nset = 45\npicture = 2\n';
  writeFileSync(rig, `${readFileSync(RIG, "utf8")}\n${fault}`);
  const daemon = await new RealDaemon(["--config", rig], join(folder, "sessions")).start();
  await page.goto(daemon.url);
  await page.getByLabel("Name of the next recording").fill("unplugged");
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.locator(".state")).toHaveText("Recording");
  await expect(page.getByRole("alert").filter({ hasText: "Plug it in again" })).toBeVisible();
  await expect(page.locator(".events .event-fault")).toContainText("disconnected");
  await expect(page.locator(".events .event-gap")).toBeVisible();
  const scans = async () => Number((await page.locator(".recording-line").innerText()).match(/([\d,]+) scans/)?.[1]);
  const before = await scans();
  await expect.poll(scans).toBeGreaterThan(before + 5);
  await expect(page.locator(".state")).toHaveText("Recording");
  await page.getByRole("button", { name: "Stop", exact: true }).click();
  await expect(page.getByText(/closed and verified/)).toBeVisible();
  await open(page, daemon, "#/replay/unplugged");
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeGreaterThan(0.05);
  await expect(page.locator(".timeline-marks .gap")).toHaveAttribute("title", /gap/);
  await expect(page.locator(".timeline-marks .fault")).toHaveAttribute("title", /disconnected/);
  await daemon.stop();
  rmSync(folder, { recursive: true });
});
