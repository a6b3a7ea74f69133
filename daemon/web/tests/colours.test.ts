import { describe, expect, it } from "vitest";
import { meshMessage } from "../mock/face.mjs";
import { readMesh, type Scalars } from "../src/api/mesh_message";
import { ColourRange } from "../src/scene/colour_range";
import { Surface } from "../src/scene/surface";

function message(scalars: Scalars, seconds = 1) {
  const { buffer, byteOffset, length } = meshMessage({ sequence: 1, seconds, maxVertices: 400, scalars, full: true });
  return readMesh(buffer.slice(byteOffset, byteOffset + length) as ArrayBuffer);
}

describe("the range of colours", () => {
  it("grows, tells of it, and forgets", () => {
    const range = new ColourRange();
    let told = 0;
    range.onChange(() => (told += 1));
    range.extend(2, 3);
    range.extend(2.5, 2.6);
    expect([range.span, told]).toEqual([[2, 3], 1]);
    range.extend(1, 2);
    expect([range.span, told]).toEqual([[1, 3], 2]);
    range.reset();
    expect(range.span).toBeNull();
  });

  it("spans only what the look is about", () => {
    const range = new ColourRange();
    const surface = new Surface(range);
    surface.setLook("depth");
    surface.update(message("error"), null);
    expect([surface.isColoured, range.span]).toEqual([false, null]);
    const depths = message("depth");
    surface.update(depths, null);
    expect([surface.isColoured, range.span]).toEqual([true, [depths.scalarLow, depths.scalarHigh]]);
    surface.setLook("motion");
    expect(surface.isColoured).toBe(false);
  });

  it("has depths that are distances from the scanner", () => {
    const { scalars, positions, originMm, stepMm, scalarLow, scalarHigh, vertices } = message("depth");
    for (let v = 0; v < vertices; v += 7) {
      const depth = -(originMm[2] + stepMm[2] * positions[3 * v + 2]!);
      const shown = scalarLow + ((scalarHigh - scalarLow) * scalars![v]!) / 255;
      expect(Math.abs(depth - shown)).toBeLessThan(1.01);
    }
  });
});
