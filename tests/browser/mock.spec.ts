import { MockDaemon } from "./daemon";
import { expect, open, test } from "./fixtures";

const TOKEN = "correct-horse";

test("a cable pulled during a recording is told, with what to do", async ({ page, daemon }) => {
  const mock = daemon as MockDaemon;
  await open(page, daemon, "#/operate");
  await page
    .getByRole("button", { name: /^(Start|Stop) scanner$/ })
    .first()
    .waitFor();
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.locator(".state")).toHaveText("Recording");
  await mock.set({ unplug: true });
  await expect(page.getByRole("alert").filter({ hasText: "Plug it in again" })).toBeVisible();
  await expect(page.locator(".events")).toContainText("camera");
  await expect(page.locator(".picture .stale")).toContainText(/stale since \d+ s/);
  await mock.set({ unplug: false });
  await expect(page.locator(".picture .stale")).toBeHidden();
  await page.getByRole("button", { name: "Stop", exact: true }).click();
  await expect(page.getByText(/closed and verified/)).toBeVisible();
});

test("a full disk ends the recording, and says what to do", async ({ page, daemon }) => {
  const mock = daemon as MockDaemon;
  await open(page, daemon, "#/operate");
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.locator(".state")).toHaveText("Recording");
  await page.waitForTimeout(500);
  await mock.set({ full: true });
  await expect(page.getByRole("alert").filter({ hasText: "down to its floor" })).toBeVisible();
  await page.getByRole("button", { name: "Record", exact: true }).click();
  await expect(page.getByRole("alert").filter({ hasText: "The disk is full" })).toBeVisible();
  await mock.set({ full: false });
});

test("a token is asked for, and a wrong one refused in words", async ({ page }) => {
  const locked = await new MockDaemon(TOKEN).start();
  await page.goto(locked.url);
  await page.getByLabel("Token").fill("wrong");
  await page.getByRole("button", { name: "Log in" }).click();
  await expect(page.getByText("That token is not right")).toBeVisible();
  await page.getByLabel("Token").fill(TOKEN);
  await page.getByRole("button", { name: "Log in" }).click();
  await expect(page.getByRole("dialog")).toBeHidden();
  await expect(page.locator(".pill")).toHaveText("idle");
  await locked.stop();
});

test("an unfinished session is recovered", async ({ page, daemon }) => {
  await open(page, daemon, "#/sessions");
  await page.getByRole("button", { name: "More… power-cut" }).click();
  await page.getByRole("button", { name: "Recover" }).click();
  await expect(page.getByRole("row").filter({ hasText: "power-cut" }).locator(".badge")).toHaveText("complete");
});

test("reports of a sweep and a measurement are drawn", async ({ page, daemon }) => {
  await open(page, daemon, "#/measure");
  await page.getByLabel("Report").selectOption("sweep-face");
  await expect(page.getByRole("heading", { name: "Rate and error" })).toBeVisible();
  await page.getByLabel("Report").selectOption("smile-measure");
  await expect(page.getByRole("heading", { name: "Error of every scan" })).toBeVisible();
});
