import { drawnShare, expect, open, test } from "./fixtures";

test("previews, records, marks, stops, and the session is there", async ({ page, daemon }, info) => {
  await open(page, daemon, "#/operate");
  await page.getByRole("button", { name: "Start scanner" }).click();
  await expect(page.getByRole("button", { name: "Stop scanner" })).toBeEnabled({ timeout: 30_000 });
  await expect.poll(() => drawnShare(page, ".picture-box canvas"), { timeout: 60_000 }).toBeGreaterThan(0.05);
  await expect.poll(() => drawnShare(page, ".live-mesh canvas"), { timeout: 60_000 }).toBeGreaterThan(0.05);
  for (const view of ["Fringes", "Modulation", "Phase", "Mask"]) {
    await page.getByRole("button", { name: view, exact: true }).click();
    await expect.poll(() => drawnShare(page, ".picture-box canvas"), { message: view }).toBeGreaterThan(0.05);
  }
  const name = `take-${info.project.name}`;
  await page.getByLabel("Name of the next recording").fill(name);
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.locator(".state")).toHaveText("Recording");
  await expect(page.locator(".recording-line")).toContainText(name);
  await page.getByRole("button", { name: "Mark", exact: true }).click();
  await page.getByLabel("Text").fill("laughs");
  await page.getByRole("dialog").getByRole("button", { name: "Mark" }).click();
  await expect(page.getByText(/Marked at tick/)).toBeVisible();
  await page.waitForTimeout(3000);
  await page.getByRole("button", { name: "Stop", exact: true }).click();
  await expect(page.getByText(/closed and verified/)).toBeVisible({ timeout: 30_000 });
  await page.keyboard.press("s");
  await expect(page.getByRole("link", { name, exact: true })).toBeVisible();
  await page.getByRole("button", { name: `Replay ${name}` }).click();
  await expect.poll(() => drawnShare(page, "canvas.surface"), { timeout: 60_000 }).toBeGreaterThan(0.05);
  await expect(page.locator(".timeline-marks .mark")).toHaveAttribute("title", /laughs/);

  await page.keyboard.press("s");
  await page.getByRole("button", { name: `More… ${name}`, exact: true }).click();
  await page.getByRole("button", { name: "Delete…" }).click();
  await page.getByRole("button", { name: "Delete", exact: true }).click();
  await expect(page.getByText(`${name} deleted`)).toBeVisible();
  await expect(page.getByRole("link", { name, exact: true })).toBeHidden();
});

test("says what is plugged in and what the doctor finds", async ({ page, daemon }) => {
  await open(page, daemon, "#/operate");
  await expect(page.locator(".devices li").first()).toBeVisible();
  await page.getByRole("button", { name: "Examine" }).click();
  // It needs the devices for itself: a daemon whose scanner runs says why it does not.
  const answer = page.locator(".checks li").or(page.getByRole("alert").filter({ hasText: /doctor|scanner/ }));
  await expect(answer.first()).toBeVisible({ timeout: 60_000 });
});

test("keys work, are listed, and can be turned off", async ({ page, daemon }) => {
  await open(page, daemon, "#/operate");
  await page.keyboard.press("?");
  await expect(page.getByRole("dialog", { name: "Keys" })).toBeVisible();
  await page.getByLabel(/Single keys work/).uncheck();
  await page.getByRole("button", { name: "Close", exact: true }).click();
  await page.keyboard.press("s");
  await page.waitForTimeout(300);
  await expect(page.getByRole("link", { name: "Operate" })).toHaveAttribute("aria-current", "page");
  await page.keyboard.press("?");
  await page.getByLabel(/Single keys work/).check();
  await page.getByRole("button", { name: "Close", exact: true }).click();
  await page.keyboard.press("s");
  await expect(page.getByRole("link", { name: "Sessions" })).toHaveAttribute("aria-current", "page");
});

test("says that it lost the daemon, and comes back by itself", async ({ page, daemon }) => {
  await open(page, daemon, "#/operate");
  await expect(page.locator(".pill")).not.toBeEmpty();
  await (daemon as unknown as { end: () => Promise<void> }).end();
  await expect(page.getByText("No connection to the daemon")).toBeVisible();
  await expect(page.locator(".bar .stale")).toContainText(/stale since \d+ s, reconnecting/);
  await (daemon as unknown as { start: () => Promise<unknown> }).start();
  await expect(page.getByText("No connection to the daemon")).toBeHidden({ timeout: 30_000 });
  await expect(page.locator(".bar .stale")).toBeHidden();
});
