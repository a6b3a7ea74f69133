import { describe, expect, it, vi } from "vitest";
import { PerspectiveCamera, Vector3 } from "three";
import { Orbit } from "../src/scene/orbit";
import { eyeFrustum, placeCamera } from "../src/scene/stereo";

const BOX = { low: [-75, -100, -600] as [number, number, number], high: [75, 100, -440] as [number, number, number] };

function seen(orbit: Orbit, point: [number, number, number], eyeOffsetMm = 0, aspect = 1.5): Vector3 {
  const camera = new PerspectiveCamera();
  placeCamera(camera, orbit, aspect, eyeOffsetMm);
  camera.updateMatrixWorld();
  return new Vector3(...point).project(camera);
}

describe("an orbit", () => {
  it.each([1.5, 1, 0.4])("shows all corners of the box it was fitted to, %f times as wide as high", (aspect) => {
    const orbit = new Orbit();
    orbit.fit(BOX);
    for (const x of [BOX.low[0], BOX.high[0]]) {
      for (const y of [BOX.low[1], BOX.high[1]]) {
        for (const z of [BOX.low[2], BOX.high[2]]) {
          const p = seen(orbit, [x, y, z], 0, aspect);
          expect(Math.max(Math.abs(p.x), Math.abs(p.y), Math.abs(p.z))).toBeLessThan(1);
        }
      }
    }
  });

  it("keeps its target in the middle whichever way it turns, and x right, y up at the front", () => {
    const orbit = new Orbit();
    orbit.fit(BOX);
    expect(seen(orbit, [50, 0, -520]).x).toBeGreaterThan(0.1);
    expect(seen(orbit, [0, 50, -520]).y).toBeGreaterThan(0.1);
    for (const [a, e] of [
      [0.7, 0.3],
      [-2, -1],
      [9, 4],
    ] as const) {
      orbit.turn(a, e);
      const p = seen(orbit, orbit.target);
      expect(Math.hypot(p.x, p.y)).toBeLessThan(1e-6);
      const { right, up, back } = orbit.axes();
      const dot = (u: number[], v: number[]) => u[0]! * v[0]! + u[1]! * v[1]! + u[2]! * v[2]!;
      expect(dot(right, up)).toBeCloseTo(0, 9);
      expect(dot(up, back)).toBeCloseTo(0, 9);
      expect(dot(back, back)).toBeCloseTo(1, 9);
    }
  });

  it("pans the surface along with the hand", () => {
    const orbit = new Orbit();
    orbit.fit(BOX);
    const before = seen(orbit, [0, 0, -520]);
    orbit.pan(-0.1, 0.1);
    const after = seen(orbit, [0, 0, -520]);
    expect(after.x - before.x).toBeCloseTo(0.2 / 1.5, 5);
    expect(after.y - before.y).toBeCloseTo(-0.2, 5);
  });

  it("tells everyone who shares it", () => {
    const orbit = new Orbit();
    const [one, two] = [vi.fn(), vi.fn()];
    orbit.onChange(one);
    const forget = orbit.onChange(two);
    orbit.turn(0.1, 0);
    forget();
    orbit.zoom(0.5);
    expect([one.mock.calls.length, two.mock.calls.length]).toEqual([2, 1]);
  });
});

describe("stereo", () => {
  it("has no parallax at the target, none upwards anywhere, and less right for the left eye behind it", () => {
    const orbit = new Orbit();
    orbit.fit(BOX);
    const at = (point: [number, number, number]) => [seen(orbit, point, -20), seen(orbit, point, 20)] as const;
    const [l0, r0] = at([30, 40, orbit.target[2]]);
    expect(l0.x).toBeCloseTo(r0.x, 6);
    for (const z of [-640, -420]) {
      const [l, r] = at([30, 40, z]);
      expect(l.y).toBeCloseTo(r.y, 6);
      expect(Math.sign(r.x - l.x)).toBe(z < orbit.target[2] ? 1 : -1);
    }
  });

  it("frusta of the eyes are mirrored", () => {
    const [left, right] = [eyeFrustum(1.5, 800, -16), eyeFrustum(1.5, 800, 16)];
    expect(left[0]).toBeCloseTo(-right[1], 9);
    expect(left[1]).toBeCloseTo(-right[0], 9);
    expect(left[2]).toBe(right[2]);
  });
});
