/** A curve: points in order, with what to call it. */
export interface Series {
  name: string;
  x: number[];
  /** Where there is no value, the curve has a gap. */
  y: (number | null)[];
  /** Points that carry a mark, as keyframes do; none when left out. */
  marks?: boolean[];
  /** A word on every point, for hovering: the setting of a coder. */
  labels?: string[];
  /** Upright lines from the ground instead of a curve. */
  bars?: boolean;
  /** A mark on every point. */
  dots?: boolean;
}

/** What a plot shows. */
export interface PlotData {
  title: string;
  xLabel: string;
  yLabel: string;
  series: Series[];
  xLog?: boolean;
  yLog?: boolean;
}

/** Lowest and highest of numbers; for a logarithm only those above zero count. */
export function range(values: Iterable<number | null>, log: boolean): [number, number] | null {
  let [low, high] = [Infinity, -Infinity];
  for (const v of values) {
    if (v === null || !Number.isFinite(v) || (log && v <= 0)) continue;
    low = Math.min(low, v);
    high = Math.max(high, v);
  }
  return low <= high ? [low, high] : null;
}

/** A table of all series: one line for each point. RFC 4180. */
export function csv({ xLabel, yLabel, series }: PlotData): string {
  const quoted = (text: string) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const lines = [["series", xLabel, yLabel, "label", "marked"].map(quoted).join(",")];
  for (const { name, x, y, labels, marks } of series) {
    for (const [k, value] of x.entries()) {
      lines.push([quoted(name), value, y[k] ?? "", quoted(labels?.[k] ?? ""), marks?.[k] ? 1 : 0].join(","));
    }
  }
  return `${lines.join("\n")}\n`;
}
