import { describe, expect, it } from "vitest";
import { MessageError, readMesh } from "../src/api/mesh_message";
import { readPicture } from "../src/api/picture_message";
import { meshMessage } from "../mock/face.mjs";
import { wireIndices } from "../src/scene/surface";

const exact = (buffer: Buffer) =>
  buffer.buffer.slice(buffer.byteOffset, buffer.byteOffset + buffer.length) as ArrayBuffer;
const message = (over = {}) =>
  exact(meshMessage({ sequence: 7, seconds: 1.5, maxVertices: 900, scalars: "error", full: true, ...over }));

describe("mesh messages", () => {
  it("come out as they went in", () => {
    const mesh = readMesh(message());
    expect(mesh).toMatchObject({ full: true, sequence: 7, topologyId: 1, timeSeconds: 1.5, scalarLow: 0 });
    expect(mesh.scalarHigh).toBeCloseTo(0.3, 6);
    expect(mesh.positions.length).toBe(3 * mesh.vertices);
    expect(mesh.uv?.length).toBe(2 * mesh.vertices);
    expect(mesh.scalars?.length).toBe(mesh.vertices);
    expect(mesh.scalarKind).toBe("error");
    expect(mesh.triangles?.length).toBe(3 * mesh.triangleCount);
    expect(Math.max(...mesh.triangles!)).toBe(mesh.vertices - 1);
    const xs = Array.from(
      { length: mesh.vertices },
      (_, k) => mesh.originMm[0] + mesh.stepMm[0] * mesh.positions[3 * k]!,
    );
    expect(Math.max(...xs)).toBeLessThanOrEqual(75.001);
    expect(Math.min(...xs)).toBeGreaterThanOrEqual(-75.001);
  });

  it("carry positions alone while the triangles hold", () => {
    const mesh = readMesh(message({ full: false, scalars: "none" }));
    expect(mesh).toMatchObject({ full: false, uv: null, scalars: null, triangles: null, texture: null });
    expect(mesh.scalarKind).toBe("none");
  });

  it("are refused when cut short anywhere, or of another kind", () => {
    const whole = message();
    for (const length of [0, 3, 71, 72, 500, whole.byteLength - 1]) {
      expect(() => readMesh(whole.slice(0, length)), `${length} bytes`).toThrow(MessageError);
    }
    const other = whole.slice(0);
    new DataView(other).setUint32(0, 1, true);
    expect(() => readMesh(other)).toThrow("not a mesh message");
    const newer = whole.slice(0);
    new DataView(newer).setUint8(4, 9);
    expect(() => readMesh(newer)).toThrow("version 9");
    const huge = whole.slice(0);
    new DataView(huge).setUint32(24, 0xffffffff, true);
    expect(() => readMesh(huge)).toThrow(MessageError);
  });
});

describe("picture messages", () => {
  it("hold a picture of the kind its first bytes say", () => {
    const bytes = new Uint8Array(30);
    new DataView(bytes.buffer).setUint32(0, 0x50335647, true);
    new DataView(bytes.buffer).setUint32(8, 4, true);
    expect(readPicture(bytes.buffer)).toMatchObject({ sequence: 4, image: { type: "image/jpeg", size: 6 } });
    bytes[24] = 0x89;
    expect(readPicture(bytes.buffer).image.type).toBe("image/png");
    expect(() => readPicture(bytes.buffer.slice(0, 24))).toThrow(MessageError);
    expect(() => readPicture(new ArrayBuffer(0))).toThrow();
  });
});

it("wires are the three sides of every triangle", () => {
  expect([...wireIndices(Uint32Array.of(0, 1, 2, 2, 1, 3))]).toEqual([0, 1, 1, 2, 2, 0, 2, 1, 1, 3, 3, 2]);
});
