import { svg } from "../ui/dom";

/** A minute at two values a second. */
const KEPT = 120;
const WIDTH = 120;
const HEIGHT = 28;

/** A small curve of the newest values; null is a gap. */
export class Sparkline {
  private readonly values: (number | null)[] = [];
  private readonly path = svg("path", { class: "spark", d: "" });
  readonly element: SVGSVGElement;

  constructor(label: string) {
    this.element = svg(
      "svg",
      {
        viewBox: `0 0 ${WIDTH} ${HEIGHT}`,
        class: "sparkline",
        role: "img",
        "aria-label": label,
        preserveAspectRatio: "none",
      },
      this.path,
    );
  }

  add(value: number | null): void {
    this.values.push(value);
    if (this.values.length > KEPT) this.values.shift();
    this.path.setAttribute("d", sparkPath(this.values));
  }
}

/** Path from zero at the ground to the largest value near the top, newest at the right. */
export function sparkPath(values: (number | null)[]): string {
  const top = Math.max(1e-9, ...values.map((v) => v ?? 0)) * 1.1;
  const first = KEPT - values.length;
  let pen = "M";
  return values
    .map((v, k) => {
      if (v === null) {
        pen = "M";
        return "";
      }
      const place = `${(((first + k) * WIDTH) / (KEPT - 1)).toFixed(1)} ${(HEIGHT * (1 - v / top)).toFixed(1)}`;
      const step = pen + place;
      pen = "L";
      return step;
    })
    .join("");
}
