import { drawnShare, expect, FIRST, open, SECOND, shownSeconds, test } from "./fixtures";

test("replays a session, in every look", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  const moment = () => page.locator(".timeline-now").innerText();
  const first = await moment();
  await expect.poll(moment).not.toBe(first);
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeGreaterThan(0.05);
  for (const look of ["Shaded", "Wires", "Skin tone", "Depth", "Error", "Motion", "Textured"]) {
    await page.getByRole("button", { name: look, exact: true }).click();
    await expect.poll(() => drawnShare(page, "canvas.surface"), { message: look }).toBeGreaterThan(0.03);
    const hasLegend = ["Depth", "Error", "Motion"].includes(look);
    await expect(page.locator(".legend")).toBeVisible({ visible: hasLegend });
  }
});

test("scrubs, steps, changes speed and direction, by hand and by key", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  await page.getByRole("button", { name: "Pause", exact: true }).click();
  const slider = page.getByRole("slider", { name: "Time in the session" });
  const length = Number(await slider.getAttribute("max"));
  expect(length).toBeGreaterThan(0.5);
  await slider.fill(String(length / 2));
  await expect.poll(() => shownSeconds(page)).toBeCloseTo(length / 2, 1);
  const before = await shownSeconds(page);
  await page.getByRole("button", { name: "One scan on" }).click();
  await expect.poll(() => shownSeconds(page)).toBeGreaterThan(before);
  await page.locator("body").press(",");
  await expect.poll(() => shownSeconds(page)).toBeCloseTo(before, 1);
  await page.keyboard.press("Home");
  await expect.poll(() => shownSeconds(page)).toBe(0);
  await page.keyboard.press("End");
  await expect.poll(() => shownSeconds(page)).toBeCloseTo(length, 1);
  await page.getByRole("button", { name: "Reverse" }).click();
  await page.getByLabel("Speed").selectOption("0.5");
  await page.getByRole("button", { name: "Play", exact: true }).click();
  await expect.poll(() => shownSeconds(page)).toBeLessThan(length - 0.05);
});

test("stops at the end without the loop", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  await page.getByRole("button", { name: "Loop" }).click();
  await page.getByLabel("Speed").selectOption("4");
  await expect(page.getByRole("button", { name: "Play", exact: true })).toBeVisible({ timeout: 60_000 });
});

test("turns, moves and zooms by mouse and keys", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  await page.getByRole("button", { name: "Pause", exact: true }).click();
  await page.getByRole("button", { name: "Shaded" }).click();
  const canvas = page.locator("canvas.surface");
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeGreaterThan(0.03);
  const before = await drawnShare(page, "canvas.surface");
  await canvas.focus();
  for (let k = 0; k < 8; k += 1) await page.keyboard.press("-");
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeLessThan(before * 0.6);
  await page.keyboard.press("0");
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeGreaterThan(before * 0.8);
  const box = (await canvas.boundingBox())!;
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await page.mouse.down();
  await page.mouse.move(box.x + box.width * 0.8, box.y + box.height / 2, { steps: 4 });
  await page.mouse.up();
  await page.mouse.wheel(0, 600);
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeLessThan(before * 0.8);
});

test("shows red-cyan and side by side", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  await page.getByRole("button", { name: "Shaded" }).click();
  for (const mode of ["Red-cyan", "Side by side"]) {
    await page.getByRole("button", { name: mode, exact: true }).click();
    await expect.poll(() => drawnShare(page, "canvas.surface"), { message: mode }).toBeGreaterThan(0.05);
  }
});

test("shows the tracked mesh, and keeps that in the address", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  await page.getByRole("button", { name: "Tracked mesh" }).click();
  await expect.poll(() => drawnShare(page, "canvas.surface")).toBeGreaterThan(0.05);
  expect(page.url()).toContain("as=mesh");
});

test("two sessions side by side show the same moment", async ({ page, daemon }) => {
  await open(page, daemon, `#/replay/${FIRST}`);
  await page.getByLabel("Beside").selectOption(SECOND);
  await expect(page.locator("canvas.surface")).toHaveCount(2);
  const first = await shownSeconds(page);
  await expect.poll(() => shownSeconds(page)).not.toBe(first);
  await page.getByRole("button", { name: "Pause", exact: true }).click();
  await page.getByRole("slider", { name: "Time in the session" }).fill("0.4");
  await expect.poll(() => shownSeconds(page)).toBeCloseTo(0.4, 1);
  await expect.poll(() => drawnShare(page, ".stage:nth-child(2) canvas")).toBeGreaterThan(0.03);
});

test("a session that is not there is said in words", async ({ page, daemon }) => {
  await page.goto(`${daemon.url}#/replay/nothing-of-that-name`);
  await expect(
    page
      .getByRole("alert")
      .filter({ hasText: /no|not/i })
      .first(),
  ).toBeVisible();
});
