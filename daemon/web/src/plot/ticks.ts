/** Round numbers on an axis, and how to write them. */
export interface Ticks {
  values: number[];
  format: (value: number) => string;
}

/** Multiples of 1, 2 or 5 times a power of ten within [low, high], about `wanted` of them. */
export function tickValues(low: number, high: number, wanted: number): Ticks {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return { values: [low], format: (v) => String(+v.toPrecision(4)) };
  const rough = span / Math.max(1, wanted);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((digit) => digit * power >= rough * 0.999) ?? 10);
  const first = Math.ceil(low / step - 1e-9);
  const values = [];
  for (let k = first; k * step <= high + step * 1e-9; k += 1) values.push(k * step);
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return { values, format: (v) => withThin(v.toFixed(Math.min(decimals, 9))) };
}

/** Powers of ten within [low, high], with 2 and 5 between where there is room. */
export function logTicks(low: number, high: number): Ticks {
  const decades = Math.log10(high / low);
  const digits = decades > 4 ? [1] : decades > 1.5 ? [1, 3] : [1, 2, 5];
  const values = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
    for (const digit of digits) {
      const value = digit * 10 ** power;
      if (value >= low * 0.999 && value <= high * 1.001) values.push(value);
    }
  }
  return { values, format: (v) => withThin(String(+v.toPrecision(3))) };
}

/** Thousands apart by a thin space. */
function withThin(text: string): string {
  const [whole = "", rest] = text.split(".");
  const spaced = whole.replace(/\B(?=(\d{3})+$)/g, "\u2009");
  return rest ? `${spaced}.${rest}` : spaced;
}
