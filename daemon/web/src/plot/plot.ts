import { button, h, setText, svg } from "../ui/dom";
import { download } from "../ui/download";
import { makeAxis, paddedRange, type Axis } from "./axis";
import { csv, range, type PlotData, type Series } from "./series";
import { PLOT_STYLE } from "./style";

const MARGIN = { left: 64, right: 16, top: 12, bottom: 44 };
const SYMBOLS = ["circle", "square", "triangle", "diamond"] as const;

interface Place {
  series: number;
  point: number;
  x: number;
  y: number;
}

/** A plot with axes, legend and hover; keys step along the points; downloadable as SVG and CSV. */
export class Plot {
  readonly element: HTMLElement;
  private readonly stage = h("div", { class: "plot-stage", tabindex: "0", role: "img" });
  private readonly legend = h("div", { class: "plot-legend", role: "group", "aria-label": "Curves shown" });
  private readonly readout = h("p", { class: "plot-readout", "aria-live": "polite" });
  private readonly resize = new ResizeObserver(() => this.draw());
  private readonly hidden = new Set<string>();
  private places: Place[] = [];
  private cursor = svg("g", { class: "cursor" });
  private chosen = -1;

  constructor(private data: PlotData) {
    const tools = h(
      "div",
      { class: "plot-tools" },
      button("SVG", () => this.downloadSvg(), { "aria-label": `Download “${data.title}” as SVG` }),
      button("CSV", () => download(`${fileName(this.data.title)}.csv`, "text/csv", csv(this.data)), {
        "aria-label": `Download “${data.title}” as CSV`,
      }),
    );
    this.element = h(
      "figure",
      { class: "plot" },
      h("figcaption", {}, h("h3", {}, data.title), tools),
      this.legend,
      this.stage,
      this.readout,
    );
    this.stage.addEventListener("pointermove", (event) => this.hover(event));
    this.stage.addEventListener("pointerleave", () => this.choose(-1));
    this.stage.addEventListener("keydown", (event) => this.step(event));
    this.resize.observe(this.stage);
    this.show(data);
  }

  /** Draws other data in the same place. */
  show(data: PlotData): void {
    this.data = data;
    this.legend.replaceChildren(...data.series.map((series, k) => this.legendButton(series, k)));
    this.legend.hidden = data.series.length < 2;
    this.draw();
  }

  dispose(): void {
    this.resize.disconnect();
  }

  private legendButton({ name }: Series, k: number): HTMLElement {
    const toggle = button(
      "",
      () => {
        if (!this.hidden.delete(name)) this.hidden.add(name);
        toggle.setAttribute("aria-pressed", String(!this.hidden.has(name)));
        this.draw();
      },
      { "aria-pressed": !this.hidden.has(name) ? "true" : "false", class: "legend-entry" },
    );
    const sample = svg("svg", { width: 24, height: 12, class: `series-${k % 8}`, "aria-hidden": "true" });
    sample.append(svg("line", { x1: 1, x2: 23, y1: 6, y2: 6, class: "curve" }), symbol(k, 12, 6));
    toggle.append(sample, name);
    return toggle;
  }

  private draw(): void {
    const width = Math.max(280, this.stage.clientWidth);
    const height = Math.max(200, this.stage.clientHeight);
    const picture = this.picture(width, height);
    this.stage.setAttribute("aria-label", this.description());
    this.stage.replaceChildren(picture);
    this.chosen = -1;
    setText(this.readout, "");
  }

  /** In words, for those who do not see it. */
  private description(): string {
    const parts = this.data.series.map((s) => {
      const r = range(s.y, false);
      return r ? `${s.name} from ${brief(r[0])} to ${brief(r[1])}` : `${s.name} without values`;
    });
    return `${this.data.title}: ${this.data.yLabel} over ${this.data.xLabel}. ${parts.join("; ")}. Arrow keys step through the points.`;
  }

  private picture(width: number, height: number): SVGSVGElement {
    const { data } = this;
    const root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, class: "plot-picture" });
    const visible = data.series.filter((s) => !this.hidden.has(s.name));
    const xs = range(
      visible.flatMap((s) => s.x),
      data.xLog ?? false,
    );
    const ys = range(
      visible.flatMap((s) => s.y),
      data.yLog ?? false,
    );
    this.places = [];
    if (!xs || !ys) {
      root.append(svg("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, "No values to draw"));
      return root;
    }
    const { left, right, top, bottom } = MARGIN;
    const xAxis = makeAxis(
      data.xLog ? paddedRange(xs, true) : xs,
      data.xLog ?? false,
      [left, width - right],
      width / 90,
    );
    const bars = data.series.some((s) => s.bars);
    const yAxis = makeAxis(
      paddedRange(ys, data.yLog ?? false, bars),
      data.yLog ?? false,
      [height - bottom, top],
      height / 55,
    );
    root.append(frame(data, xAxis, yAxis, width, height));
    for (const [k, series] of data.series.entries()) {
      if (!this.hidden.has(series.name)) root.append(this.curve(series, k, xAxis, yAxis, height - bottom));
    }
    this.cursor = svg("g", { class: "cursor" });
    root.append(this.cursor);
    this.places.sort((a, b) => a.x - b.x);
    return root;
  }

  private curve(series: Series, k: number, xAxis: Axis, yAxis: Axis, groundPx: number): SVGGElement {
    const group = svg("g", { class: `series-${k % 8}` });
    let path = "";
    let begun = false;
    for (const [i, x] of series.x.entries()) {
      const y = series.y[i];
      const usable = y != null && !(this.data.yLog && y <= 0) && !(this.data.xLog && x <= 0);
      if (!usable) {
        begun = false;
        continue;
      }
      const [px, py] = [xAxis.toPx(x), yAxis.toPx(y)];
      this.places.push({ series: k, point: i, x: px, y: py });
      if (series.bars) path += `M${px.toFixed(1)} ${groundPx.toFixed(1)}V${py.toFixed(1)}`;
      else path += `${begun ? "L" : "M"}${px.toFixed(1)} ${py.toFixed(1)}`;
      begun = true;
      if (series.dots || series.marks?.[i]) group.append(symbol(k, px, py));
    }
    group.prepend(svg("path", { d: path, class: "curve" }));
    return group;
  }

  private hover(event: PointerEvent): void {
    const box = this.stage.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    let [best, nearest] = [-1, Infinity];
    for (const [k, place] of this.places.entries()) {
      const distance = Math.abs(place.x - x) + 0.3 * Math.abs(place.y - y);
      if (distance < nearest) [best, nearest] = [k, distance];
    }
    this.choose(best);
  }

  private step(event: KeyboardEvent): void {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!by || this.places.length === 0) return;
    event.preventDefault();
    this.choose(Math.max(0, Math.min(this.places.length - 1, this.chosen + by)));
  }

  private choose(k: number): void {
    this.chosen = k;
    const place = this.places[k];
    this.cursor.replaceChildren();
    const series = place && this.data.series[place.series];
    if (!place || !series) {
      setText(this.readout, "");
      return;
    }
    const bottom = Number(this.cursor.ownerSVGElement?.getAttribute("height") ?? 0) - MARGIN.bottom;
    this.cursor.append(
      svg("line", { x1: place.x, x2: place.x, y1: MARGIN.top, y2: bottom }),
      svg("circle", { cx: place.x, cy: place.y, r: 4.5 }),
    );
    const label = series.labels?.[place.point];
    const marked = series.marks?.[place.point] ? ", keyframe" : "";
    const [x, y] = [series.x[place.point]!, series.y[place.point]!];
    const values = `${this.data.xLabel} ${brief(x)}, ${this.data.yLabel} ${brief(y)}`;
    setText(this.readout, `${series.name}${label ? ` (${label})` : ""}: ${values}${marked}`);
  }

  private downloadSvg(): void {
    const picture = this.picture(900, 480);
    picture.setAttribute("xmlns", "http://www.w3.org/2000/svg");
    picture.prepend(svg("style", {}, PLOT_STYLE), svg("rect", { width: 900, height: 480, fill: "#fff" }));
    for (const [k, { name }] of this.data.series.entries()) {
      const entry = svg("g", { class: `series-${k % 8}` }, symbol(k, MARGIN.left + 12, 24 + 18 * k));
      entry.append(svg("text", { x: MARGIN.left + 24, y: 28 + 18 * k }, name));
      picture.append(entry);
    }
    const text = new XMLSerializer().serializeToString(picture);
    this.draw();
    download(`${fileName(this.data.title)}.svg`, "image/svg+xml", text);
  }
}

function frame(data: PlotData, xAxis: Axis, yAxis: Axis, width: number, height: number): SVGGElement {
  const { left, right, top, bottom } = MARGIN;
  const group = svg("g", { class: "frame" });
  const text = (content: string, props: Record<string, string | number>) => group.append(svg("text", props, content));
  for (const v of xAxis.ticks.values) {
    const x = xAxis.toPx(v);
    group.append(svg("line", { x1: x, x2: x, y1: top, y2: height - bottom, class: "grid" }));
    text(xAxis.ticks.format(v), { x, y: height - bottom + 16, "text-anchor": "middle" });
  }
  for (const v of yAxis.ticks.values) {
    const y = yAxis.toPx(v);
    group.append(svg("line", { x1: left, x2: width - right, y1: y, y2: y, class: "grid" }));
    text(yAxis.ticks.format(v), { x: left - 6, y: y + 4, "text-anchor": "end" });
  }
  const across = (top + height - bottom) / 2;
  text(data.xLabel, { x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle", class: "label" });
  text(data.yLabel, {
    x: 0,
    y: 0,
    "text-anchor": "middle",
    class: "label",
    transform: `translate(14 ${across}) rotate(-90)`,
  });
  group.append(svg("path", { d: `M${left} ${top}V${height - bottom}H${width - right}`, class: "axis" }));
  return group;
}

/** A mark of its own shape for each series: colours alone are not enough for all eyes. */
function symbol(k: number, x: number, y: number): SVGElement {
  switch (SYMBOLS[k % SYMBOLS.length]) {
    case "square":
      return svg("rect", { x: x - 3, y: y - 3, width: 6, height: 6, class: "mark" });
    case "triangle":
      return svg("path", { d: `M${x} ${y - 4}l3.6 6.4h-7.2z`, class: "mark" });
    case "diamond":
      return svg("path", { d: `M${x} ${y - 4}l4 4l-4 4l-4 -4z`, class: "mark" });
    default:
      return svg("circle", { cx: x, cy: y, r: 3.2, class: "mark" });
  }
}

const brief = (v: number) => String(+v.toPrecision(4));
const fileName = (title: string) =>
  title
    .toLowerCase()
    .replace(/[^a-z0-9]+/g, "-")
    .replace(/^-|-$/g, "");
