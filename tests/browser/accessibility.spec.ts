import { mkdirSync } from "node:fs";
import { join } from "node:path";
import { AxeBuilder } from "@axe-core/playwright";
import { expect, FIRST, open, SECOND, test } from "./fixtures";

const VIEWS = {
  operate: "#/operate",
  sessions: "#/sessions",
  replay: `#/replay/${FIRST}`,
  compare: `#/replay/${FIRST}?with=${SECOND}`,
  measure: `#/measure/${FIRST}`,
};
const SCREENSHOTS = join(__dirname, "../../daemon/web/screenshots");

for (const theme of ["dark", "light"] as const) {
  for (const [name, hash] of Object.entries(VIEWS)) {
    test(`${name}, ${theme}: axe-core finds no serious fault`, async ({ page, daemon }, info) => {
      await page.emulateMedia({ colorScheme: theme });
      await open(page, daemon, hash);
      await page.waitForTimeout(2500);
      if (name === "operate") {
        const power = page.getByRole("button", { name: /^(Start|Stop) scanner$/ });
        if ((await power.innerText()) === "Start scanner") await power.click();
        await expect(power).toHaveText("Stop scanner", { timeout: 60_000 });
        await page.waitForTimeout(5000);
      }
      const { violations } = await new AxeBuilder({ page }).analyze();
      const serious = violations.filter((v) => v.impact === "serious" || v.impact === "critical");
      expect(serious.map((v) => `${v.id}: ${v.nodes.map((n) => n.html).join(" | ")}`)).toEqual([]);
      if (process.env["GV3_SCREENSHOTS"] && info.project.name === (process.env["GV3_SCREENSHOTS_OF"] ?? "gv3")) {
        mkdirSync(SCREENSHOTS, { recursive: true });
        await page.waitForFunction(() => [...document.images].every((picture) => picture.complete));
        // On a machine with much else to do a replay stalls; one that is paused is never stale.
        if (hash.startsWith("#/replay")) await page.getByRole("button", { name: "Pause", exact: true }).click();
        await expect(page.locator(".stale:visible")).toHaveCount(0);
        await page.screenshot({ path: join(SCREENSHOTS, `${name}-${theme}.jpg`), type: "jpeg", quality: 80 });
      }
      // A running scanner comes before every replay.
      if (name === "operate") await page.getByRole("button", { name: "Stop scanner" }).click();
    });
  }
}

for (const [form, width, height] of [
  ["tablet", 820, 1180],
  ["phone", 390, 844],
] as const) {
  test(`nothing is wider than a ${form}`, async ({ page, daemon }) => {
    await page.setViewportSize({ width, height });
    for (const hash of Object.values(VIEWS)) {
      await open(page, daemon, hash);
      await page.waitForTimeout(500);
      const excess = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
      expect(excess, hash).toBeLessThanOrEqual(0);
    }
  });
}
