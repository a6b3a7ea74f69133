import { describe, expect, it } from "vitest";
import { advance, Barrier } from "../src/replay/lock_step";
import { neighbourSpeed, SPEEDS } from "../src/replay/transport";
import { sparkPath } from "../src/plot/sparkline";

describe("a clock", () => {
  const pace = { speed: 0.5, reverse: false, loop: false, lengthSeconds: 2 };

  it("goes at its speed, either way", () => {
    expect(advance(1, 0.04, pace).time).toBeCloseTo(1.02, 9);
    expect(advance(1, 0.04, { ...pace, reverse: true }).time).toBeCloseTo(0.98, 9);
  });

  it("stops at its ends, or begins again", () => {
    expect(advance(1.999, 0.1, pace)).toEqual({ time: 2, ended: true });
    expect(advance(0.001, 0.1, { ...pace, reverse: true })).toEqual({ time: 0, ended: true });
    expect(advance(1.999, 0.1, { ...pace, loop: true })).toEqual({ time: 0, ended: false });
    expect(advance(0.001, 0.1, { ...pace, reverse: true, loop: true })).toEqual({ time: 2, ended: false });
  });

  it("does not leap after the page slept", () => {
    expect(advance(0, 60, pace).time).toBeCloseTo(0.05, 9);
  });
});

it("a barrier opens when the last side arrives, once", () => {
  const barrier = new Barrier(2);
  barrier.ask();
  expect([barrier.arrived(1), barrier.waiting, barrier.arrived(1), barrier.arrived(0)]).toEqual([
    false,
    true,
    false,
    true,
  ]);
  expect(barrier.arrived(0)).toBe(false);
});

it("speeds step from one to the next and stay within", () => {
  expect(neighbourSpeed(1, 1)).toBe(2);
  expect(neighbourSpeed(1, -1)).toBe(0.5);
  expect(neighbourSpeed(SPEEDS[0], -1)).toBe(SPEEDS[0]);
  expect(neighbourSpeed(4, 1)).toBe(4);
});

it("a small curve breaks where there is nothing", () => {
  expect(sparkPath([1, null, 1]).match(/M/g)?.length).toBe(2);
  expect(sparkPath([null, null])).toBe("");
});
