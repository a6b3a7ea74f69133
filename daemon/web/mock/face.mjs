import { greyPng } from "./png.mjs";

/** A made-up face that talks: a grid over an ellipse, x right, y up, z towards the scanner, millimetres. Below,
 * (x, y) are places in the picture, y downwards, and depths are distances. */

const SIDE = 160;
const HALF_WIDTH_MM = 75;
const HALF_HEIGHT_MM = 100;
const MIDDLE_MM = 500;

const bump = (x, y, cx, cy, wx, wy) => Math.exp(-(((x - cx) / wx) ** 2) - ((y - cy) / wy) ** 2);

/** Depth at (x, y), both from -1 to 1, at a time. */
function depthMm(x, y, seconds) {
  const open = 0.5 + 0.5 * Math.sin(seconds * 7) * Math.sin(seconds * 1.7);
  const blink = Math.max(0, Math.sin(seconds * 2.1) - 0.95) * 20;
  let z = 55 * x * x + 25 * y * y;
  z -= 22 * bump(x, y, 0, 0.12, 0.16, 0.22) + 8 * bump(x, y, 0, -0.1, 0.1, 0.3);
  for (const side of [-1, 1]) {
    z += (9 - 3 * blink) * bump(x, y, 0.36 * side, -0.2, 0.17, 0.09);
    z -= 5 * bump(x, y, 0.36 * side, -0.38, 0.24, 0.07) + 5 * bump(x, y, 0.5 * side, 0.12, 0.25, 0.2);
  }
  const lip = 0.42 + 0.05 * open;
  z -= 8 * bump(x, y, 0, 0.37, 0.26, 0.045) + 8 * bump(x, y, 0, lip + 0.06, 0.24, 0.05);
  z += 10 * open * bump(x, y, 0, (0.37 + lip + 0.06) / 2, 0.2, 0.035);
  return MIDDLE_MM + z - 7 * bump(x, y, 0, 0.75 + 0.04 * open, 0.28, 0.14);
}

const pixelsOf = new Map();

/** Grid of at most so many vertices: corners, triangles, texture coordinates. */
function grid(maxVertices) {
  const side = Math.min(SIDE, Math.floor(Math.sqrt((maxVertices * 4) / Math.PI)));
  if (pixelsOf.has(side)) return pixelsOf.get(side);
  const at = new Int32Array(side * side).fill(-1);
  const points = [];
  for (let j = 0; j < side; j += 1) {
    for (let i = 0; i < side; i += 1) {
      const [x, y] = [(2 * i) / (side - 1) - 1, (2 * j) / (side - 1) - 1];
      if (x * x + y * y > 1) continue;
      at[j * side + i] = points.length;
      points.push([x, y]);
    }
  }
  const triangles = [];
  for (let j = 0; j + 1 < side; j += 1) {
    for (let i = 0; i + 1 < side; i += 1) {
      const [a, b, c, d] = [j * side + i, j * side + i + 1, (j + 1) * side + i, (j + 1) * side + i + 1].map(
        (k) => at[k],
      );
      if (a >= 0 && c >= 0 && b >= 0) triangles.push(a, c, b);
      if (b >= 0 && c >= 0 && d >= 0) triangles.push(b, c, d);
    }
  }
  const made = { points, triangles: Uint32Array.from(triangles) };
  pixelsOf.set(side, made);
  return made;
}

let picture = null;

/** The face's picture. The interface says JPEG; a browser reads either. */
function texture() {
  picture ??= greyPng(320, 320, (px, py) => {
    const [x, y] = [px / 159.5 - 1, py / 159.5 - 1];
    let v = 190 - 50 * x * x - 20 * y * y;
    for (const side of [-1, 1]) {
      v -= 110 * bump(x, y, 0.36 * side, -0.38, 0.2, 0.035) + 60 * bump(x, y, 0.36 * side, -0.2, 0.15, 0.06);
      v -= 80 * bump(x, y, 0.36 * side, -0.2, 0.05, 0.05) + 30 * bump(x, y, 0.07 * side, 0.24, 0.04, 0.03);
    }
    v -= 55 * bump(x, y, 0, 0.43, 0.26, 0.07);
    return Math.max(0, Math.min(255, v + 4 * Math.sin(px * 1.7) * Math.sin(py * 2.3)));
  });
  return picture;
}

const pad4 = (n) => (n + 3) & ~3;

/** A mesh message at a time. `sequence` 1 has everything, later ones only what moves. */
export function meshMessage({ sequence, seconds, maxVertices, scalars, full }) {
  const { points, triangles } = grid(maxVertices);
  const n = points.length;
  const jpeg = full ? texture() : Buffer.alloc(0);
  const flags = (full ? 3 : 0) | (scalars === "none" ? 0 : 4);
  const size =
    72 + pad4(6 * n) + (full ? 4 * n + 4 * triangles.length : 0) + (scalars === "none" ? 0 : pad4(n)) + jpeg.length;
  const out = Buffer.alloc(size);
  const [originMm, stepMm] = [
    [-HALF_WIDTH_MM, -HALF_HEIGHT_MM, -MIDDLE_MM - 100],
    [(2 * HALF_WIDTH_MM) / 65535, (2 * HALF_HEIGHT_MM) / 65535, 160 / 65535],
  ];
  const high = { none: 0, depth: MIDDLE_MM + 100, error: 0.3, motion: 120 }[scalars] ?? 1;
  const low = scalars === "depth" ? MIDDLE_MM - 60 : 0;
  out.writeUInt32LE(0x4d335647, 0);
  out.set([1, full ? 0 : 1, flags, ["none", "depth", "error", "motion"].indexOf(scalars)], 4);
  out.writeUInt32LE(sequence, 8);
  out.writeUInt32LE(1, 12);
  out.writeDoubleLE(seconds, 16);
  out.writeUInt32LE(n, 24);
  out.writeUInt32LE(full ? triangles.length / 3 : 0, 28);
  for (const k of [0, 1, 2]) {
    out.writeFloatLE(originMm[k], 32 + 4 * k);
    out.writeFloatLE(stepMm[k], 44 + 4 * k);
  }
  out.writeUInt32LE(jpeg.length, 56);
  out.writeFloatLE(low, 60);
  out.writeFloatLE(high, 64);
  let at = 72;
  for (const [k, [x, y]] of points.entries()) {
    const z = -depthMm(x, y, seconds);
    out.writeUInt16LE(Math.round(((x + 1) / 2) * 65535), at + 6 * k);
    out.writeUInt16LE(Math.round(((1 - y) / 2) * 65535), at + 6 * k + 2);
    out.writeUInt16LE(Math.max(0, Math.min(65535, Math.round((z - originMm[2]) / stepMm[2]))), at + 6 * k + 4);
  }
  at += pad4(6 * n);
  if (full) {
    for (const [k, [x, y]] of points.entries()) {
      out.writeUInt16LE(Math.round(((x + 1) / 2) * 65535), at + 4 * k);
      out.writeUInt16LE(Math.round(((1 - y) / 2) * 65535), at + 4 * k + 2);
    }
    at += 4 * n;
  }
  if (scalars !== "none") {
    for (const [k, [x, y]] of points.entries()) out[at + k] = scalarAt(scalars, x, y, seconds, low, high);
    at += pad4(n);
  }
  if (full) {
    Buffer.from(triangles.buffer).copy(out, at);
    at += 4 * triangles.length;
  }
  jpeg.copy(out, at);
  return out;
}

function scalarAt(kind, x, y, seconds, low, high) {
  const z = depthMm(x, y, seconds);
  const values = {
    depth: () => z,
    error: () =>
      0.06 + 0.1 * Math.abs(Math.sin(9 * x + 3 * seconds) * Math.sin(11 * y)) + 0.2 * bump(x, y, 0, 0.43, 0.3, 0.1),
    motion: () => Math.abs(depthMm(x, y, seconds + 0.01) - z) * 100,
  };
  return Math.max(0, Math.min(255, ((values[kind]() - low) / (high - low)) * 255));
}

/** A camera picture, 320 by 240, as one of the views. */
export function picturePng(view, seconds) {
  return greyPng(320, 240, (px, py) => {
    const [x, y] = [(px - 160) / 90, (py - 120) / 110];
    const inside = x * x + y * y < 1;
    if (view === "mask") return inside ? 255 : 0;
    const z = inside ? depthMm(x, y, seconds) : 620;
    const light = inside ? 150 - 60 * x * x : 25;
    const phase = px / 4 + z / 6;
    switch (view) {
      case "fringe":
        return light * (0.55 + 0.45 * Math.cos(phase + seconds));
      case "modulation":
        return inside ? 200 - 90 * (x * x + y * y) : 12;
      case "phase":
        return inside ? ((((phase / (2 * Math.PI)) % 1) + 1) % 1) * 255 : 0;
      default:
        return light * (0.9 + 0.1 * Math.cos(phase));
    }
  });
}
