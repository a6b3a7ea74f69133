import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { execFileSync } from "node:child_process";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { RealDaemon } from "./daemon";
import { expect, test } from "./fixtures";

const RIG = join(__dirname, "../../config/simulated.toml");

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

test("a disk that is down to its floor is not recorded to, in words", async ({ page }) => {
  const folder = mkdtempSync(join(tmpdir(), "gv3-full-"));
  const rig = join(folder, "rig.toml");
  // More than any disk has.
  writeFileSync(rig, `${readFileSync(RIG, "utf8")}\n[sessions]\nfree_floor_bytes = 1000000000000000000\n`);
  const daemon = await new RealDaemon(["--config", rig]).start();
  await page.goto(daemon.url);
  await expect(page.getByText("below the floor")).toBeVisible();
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(
    page
      .getByRole("alert")
      .filter({ hasText: /free|full|floor/ })
      .first(),
  ).toBeVisible();
  await daemon.stop();
  rmSync(folder, { recursive: true });
});
