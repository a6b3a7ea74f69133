import { describe, expect, it } from "vitest";
import { makeAxis, paddedRange } from "../src/plot/axis";
import { csv, range } from "../src/plot/series";
import { logTicks, tickValues } from "../src/plot/ticks";
import { bytes, clock, date, duration, ratio } from "../src/ui/format";
import { readRoute, routeHash } from "../src/ui/route";
import { checkName } from "../src/ui/session_name";
import { backoffMs } from "../src/api/socket";

describe("ticks", () => {
  it("are round, within, evenly spaced", () => {
    for (const [low, high] of [
      [0, 1],
      [-3, 17],
      [0.0011, 0.0093],
      [1e5, 9e5],
      [2.9999, 3.0001],
    ] as const) {
      const { values } = tickValues(low, high, 5);
      expect(values.length).toBeGreaterThanOrEqual(2);
      expect(values.length).toBeLessThanOrEqual(12);
      const step = values[1]! - values[0]!;
      for (const [k, v] of values.entries()) {
        expect(v).toBeGreaterThanOrEqual(low - step * 1e-6);
        expect(v).toBeLessThanOrEqual(high + step * 1e-6);
        expect(Math.abs(v - values[0]! - k * step)).toBeLessThan(step * 1e-6);
      }
    }
  });

  it("write no more decimals than they need", () => {
    const { values, format } = tickValues(0, 0.3, 5);
    expect(values.map(format)).toEqual(["0.0", "0.1", "0.2", "0.3"]);
    expect(tickValues(0, 20_000, 2).format(20_000)).toBe("20\u2009000");
    expect(tickValues(1, 1, 5).values).toEqual([1]);
  });

  it("of a logarithm are within a decade's digits", () => {
    expect(logTicks(1, 100).values).toEqual([1, 3, 10, 30, 100]);
    expect(logTicks(0.05, 1).values.map((v) => +v.toPrecision(3))).toEqual([0.05, 0.1, 0.2, 0.5, 1]);
  });
});

describe("axes", () => {
  it("map ends to ends", () => {
    const linear = makeAxis([2, 6], false, [10, 110], 5);
    expect([2, 4, 6].map(linear.toPx)).toEqual([10, 60, 110]);
    const log = makeAxis([1, 100], true, [0, 200], 5);
    expect(log.toPx(10)).toBeCloseTo(100, 9);
    expect(makeAxis([5, 5], false, [0, 100], 5).toPx(5)).toBe(0);
  });

  it("go down to zero for bars and where zero is near", () => {
    expect(paddedRange([1, 10], false)[0]).toBe(0);
    expect(paddedRange([50, 76], false)[0]).toBeGreaterThan(40);
    expect(paddedRange([50, 76], false, true)[0]).toBe(0);
  });

  it("leave out what cannot be drawn", () => {
    expect(range([null, 3, Number.NaN, 1], false)).toEqual([1, 3]);
    expect(range([0, -1], true)).toBeNull();
  });
});

it("CSV quotes what would break it", () => {
  const text = csv({
    title: "t",
    xLabel: "Time, s",
    yLabel: "y",
    series: [{ name: 'a"b', x: [1, 2], y: [3, null], marks: [true, false] }],
  });
  expect(text).toBe('series,"Time, s",y,label,marked\n"a""b",1,3,,1\n"a""b",2,,,0\n');
});

it("numbers read as people write them", () => {
  expect([0, 999, 1500, 145_420, 8.1e6, 1e12].map(bytes)).toEqual([
    "0 B",
    "999 B",
    "1.5 kB",
    "145 kB",
    "8.1 MB",
    "1 TB",
  ]);
  expect([clock(0), clock(9.96), clock(59.96), clock(61.2), clock(3723), clock(5, 0)]).toEqual([
    "0:00.0",
    "0:10.0",
    "1:00.0",
    "1:01.2",
    "1:02:03",
    "0:05",
  ]);
  expect([30, 600, 7200, 400_000].map(duration)).toEqual(["30 s", "10 min", "2 h", "5 days"]);
  expect([ratio(null), ratio(9120.4), date("never")]).toEqual(["–", "9,120 : 1", "–"]);
});

it("routes survive names of any kind", () => {
  for (const name of ["smile", "ä/ö?#%", "100%"]) {
    const route = readRoute(routeHash("replay", name, { with: "b&c" }));
    expect([route.view, route.name, route.query.get("with")]).toEqual(["replay", name, "b&c"]);
  }
  expect(readRoute("").view).toBe("operate");
  expect(readRoute("#/replay/%E0%A4%A").name).toBe("%E0%A4%A");
});

it("names that could leave the directory are refused", () => {
  for (const name of ["", "../x", "a/b", ".hidden", "a b", "x".repeat(121), "a\0"])
    expect(checkName(name), name).not.toBeNull();
  for (const name of ["smile", "2026-03-02_take.1", "Gesicht-ä"]) expect(checkName(name), name).toBeNull();
});

it("waits between attempts grow to a bound", () => {
  const waits = Array.from({ length: 12 }, (_, k) => backoffMs(k, 1));
  expect(waits.slice(0, 4)).toEqual([250, 500, 1000, 2000]);
  expect(Math.max(...waits)).toBe(5000);
  expect(backoffMs(3, 0)).toBe(1500);
});
