import { readFileSync } from "node:fs";
import { expect, FIRST, open, SECOND, test } from "./fixtures";

/** Jobs make way for everything else on the machine. */
const JOB = { timeout: 180_000 };

const pictureWidth = (picture: HTMLElement | SVGElement) => (picture as HTMLImageElement).naturalWidth;

test("lists sessions and renames one", async ({ page, daemon }) => {
  await open(page, daemon, "#/sessions");
  await expect(page.getByRole("row").filter({ hasText: FIRST }).first()).toBeVisible();
  const width = () => page.getByRole("row").filter({ hasText: FIRST }).first().locator("img").evaluate(pictureWidth);
  await expect.poll(width).toBeGreaterThan(0);
  const rename = async (from: string, to: string) => {
    await page.getByRole("button", { name: `More… ${from}`, exact: true }).click();
    await page.getByRole("button", { name: "Rename…" }).click();
    await page.getByLabel("New name").fill("../out");
    await page.getByRole("button", { name: "Rename", exact: true }).click();
    await expect(page.getByText("letters, digits")).toBeVisible();
    await page.getByLabel("New name").fill(to);
    await page.getByRole("button", { name: "Rename", exact: true }).click();
    await expect(page.getByRole("link", { name: to, exact: true })).toBeVisible();
  };
  await rename(SECOND, "renamed");
  await rename("renamed", SECOND);
});

test("verifies, exports and downloads", async ({ page, daemon }) => {
  await open(page, daemon, "#/sessions");
  await page.getByRole("button", { name: `More… ${FIRST}`, exact: true }).click();
  await page.getByRole("button", { name: "Verify" }).click();
  await expect(page.locator(".jobs li").filter({ hasText: "Verify" })).toHaveAttribute("data-state", "done", JOB);

  await page.getByRole("button", { name: `Export… ${FIRST}`, exact: true }).click();
  await page.getByLabel("Files").selectOption("ply");
  await page.getByLabel("From tick").fill("0");
  await page.getByLabel("To tick").fill("3");
  await page.getByRole("button", { name: "Export", exact: true }).click();
  const job = page.locator(".jobs li").filter({ hasText: "Export" });
  await expect(job).toHaveAttribute("data-state", "done", JOB);
  const [zip] = await Promise.all([page.waitForEvent("download"), job.getByRole("link", { name: /Save/ }).click()]);
  expect(zip.suggestedFilename()).toMatch(/\.zip$/);

  await page.getByRole("button", { name: `More… ${FIRST}`, exact: true }).click();
  const [file] = await Promise.all([
    page.waitForEvent("download"),
    page.getByRole("button", { name: "Download" }).click(),
  ]);
  expect(file.suggestedFilename()).toBe(`${FIRST}.gv3`);
});

test("exports the tracked mesh as one animation", async ({ page, daemon }, info) => {
  test.skip(info.project.name === "mock", "the mock's archives hold nothing");
  await open(page, daemon, "#/sessions");
  await page.getByRole("button", { name: `Export… ${FIRST}`, exact: true }).click();
  const excess = await page.getByRole("dialog").evaluate((dialog) => dialog.scrollWidth - dialog.clientWidth);
  expect(excess, "nothing is cut off").toBeLessThanOrEqual(0);
  await page.getByLabel("Surface").selectOption("mesh");
  await page.getByLabel("Files").selectOption("gltf");
  await page.getByRole("button", { name: "Export", exact: true }).click();
  const job = page.locator(".jobs li").filter({ hasText: "Export" });
  await expect(job).toHaveAttribute("data-state", "done", JOB);
  const [zip] = await Promise.all([page.waitForEvent("download"), job.getByRole("link", { name: /Save/ }).click()]);
  const bytes = readFileSync((await zip.path())!);
  // The archive's first entry is stored as it is: a head, a name, then glTF's own head and its JSON.
  const start = 30 + bytes.readUInt16LE(26);
  expect(bytes.toString("latin1", start, start + 4)).toBe("glTF");
  const root = JSON.parse(bytes.toString("utf8", start + 20, start + 20 + bytes.readUInt32LE(start + 12)));
  expect(root.animations[0].channels[0].target.path).toBe("weights");
  expect(root.meshes[0].primitives[0].targets.length).toBeGreaterThan(5);
  expect(root.images).toHaveLength(1);
});

test("deletes only after a yes", async ({ page, daemon }) => {
  await open(page, daemon, "#/sessions");
  await page.getByRole("button", { name: `More… ${SECOND}`, exact: true }).click();
  await page.getByRole("button", { name: "Delete…" }).click();
  await page.getByRole("button", { name: "Cancel", exact: true }).click();
  await expect(page.getByRole("link", { name: SECOND, exact: true })).toBeVisible();
});

test("compares two sessions and saves the curves", async ({ page, daemon }) => {
  await open(page, daemon, `#/measure/${FIRST}`);
  await expect(page.getByRole("heading", { name: `Bytes a scan of ${FIRST}` })).toBeVisible();
  await page.getByLabel("Against").selectOption(SECOND);
  await page.getByRole("button", { name: "Compare" }).click();
  const title = `Distance from ${FIRST} to ${SECOND}`;
  await expect(page.getByRole("heading", { name: title })).toBeVisible(JOB);
  for (const form of ["SVG", "CSV"]) {
    const save = page.getByRole("button", { name: `Download “${title}” as ${form}` });
    const [file] = await Promise.all([page.waitForEvent("download"), save.click()]);
    expect(file.suggestedFilename()).toMatch(new RegExp(`\\.${form.toLowerCase()}$`));
  }
});
