import { logTicks, tickValues, type Ticks } from "./ticks";

/** Maps values to pixels along one side of a plot. */
export interface Axis {
  toPx: (value: number) => number;
  ticks: Ticks;
}

/** An axis over [low, high] from `fromPx` to `toPx`; a linear one that comes near zero begins there. */
export function makeAxis(
  [low, high]: [number, number],
  log: boolean,
  [fromPx, toPx]: [number, number],
  wantedTicks: number,
): Axis {
  if (log) {
    if (low === high) [low, high] = [low / 2, high * 2];
    const [a, b] = [Math.log10(low), Math.log10(high)];
    const scale = (toPx - fromPx) / (b - a);
    return { toPx: (v) => fromPx + (Math.log10(v) - a) * scale, ticks: logTicks(low, high) };
  }
  if (low === high) high = low + (Math.abs(low) || 1);
  const scale = (toPx - fromPx) / (high - low);
  return { toPx: (v) => fromPx + (v - low) * scale, ticks: tickValues(low, high, wantedTicks) };
}

/** A little room around; down to zero where that is near, or asked for. */
export function paddedRange([low, high]: [number, number], log: boolean, fromZero = false): [number, number] {
  if (log) return [low / 1.15, high * 1.15];
  const ground = low >= 0 && (fromZero || low < 0.4 * high) ? 0 : low - (high - low) * 0.06;
  return [ground, high + (high - ground) * 0.06];
}
