import type { CompareReport, MeasureReport, SessionCurve, SessionDetail, SweepReport } from "./api/types";
import type { PlotData } from "./plot/series";
import { h } from "./ui/dom";
import { decimal } from "./ui/format";

/** Bytes scan by scan, and how they add up. */
export function sessionPlots(detail: SessionDetail, { ticks, bytes, is_key }: SessionCurve): PlotData[] {
  const seconds = ticks.map((t) => (t - detail.first_tick) * detail.period_nanos * 1e-9);
  let sum = 0;
  const total = bytes.map((b) => (sum += b) / 1000);
  return [
    {
      title: `Bytes a scan of ${detail.name}`,
      xLabel: "Time, s",
      yLabel: "Bytes",
      series: [{ name: "Bytes a scan", x: seconds, y: bytes, marks: is_key, bars: true }],
    },
    {
      title: `Size of ${detail.name} over time`,
      xLabel: "Time, s",
      yLabel: "Size, kB",
      series: [{ name: "Size so far", x: seconds, y: total, marks: is_key }],
    },
  ];
}

/** Distances between two sessions. */
export function comparePlots(name: string, other: string, report: CompareReport): PlotData[] {
  const { ticks: x } = report;
  return [
    {
      title: `Distance from ${name} to ${other}`,
      xLabel: "Tick",
      yLabel: "Distance, mm",
      series: [
        { name: "Root mean square", x, y: report.rms_mm },
        { name: "95th percentile", x, y: report.p95_mm },
      ],
    },
  ];
}

/** Per-scan errors of a session against the scans it was made from. */
export function measurePlots({ curve }: MeasureReport): PlotData[] {
  const x = curve.map((c) => c.time_s);
  const marks = curve.map((c) => c.is_key);
  const plots: PlotData[] = [
    {
      title: "Error of every scan",
      xLabel: "Time, s",
      yLabel: "Distance, mm",
      series: [
        { name: "Scan to replay, rms", x, y: curve.map((c) => c.scan_to_replay_rms_mm), marks },
        { name: "Replay to scan, rms", x, y: curve.map((c) => c.replay_to_scan_rms_mm), marks },
        { name: "Scan to replay, 95 %", x, y: curve.map((c) => c.scan_to_replay_p95_mm) },
        { name: "Replay to scan, 95 %", x, y: curve.map((c) => c.replay_to_scan_p95_mm) },
      ],
    },
  ];
  const decibels = curve.map((c) => c.texture_psnr_db);
  if (decibels.some((d) => d !== null)) {
    plots.push({
      title: "Texture of every scan",
      xLabel: "Time, s",
      yLabel: "PSNR, dB",
      series: [{ name: "Texture", x, y: decibels, marks }],
    });
  }
  return plots;
}

/** Rate against distortion, one curve a coder. */
export function sweepPlots({ curves }: SweepReport): PlotData[] {
  const measured = curves.filter((c) => c.points.length > 0);
  type Point = SweepReport["curves"][number]["points"][number];
  const plot = (title: string, yLabel: string, y: (p: Point) => number | null, yLog: boolean): PlotData => ({
    title,
    xLabel: "Bytes a scan",
    yLabel,
    xLog: true,
    yLog,
    series: measured.map(({ coder, points }) => {
      const sorted = [...points].sort((a, b) => a.bytes_per_scan - b.bytes_per_scan);
      const x = sorted.map((p) => p.bytes_per_scan);
      return { name: coder, x, y: sorted.map(y), labels: sorted.map((p) => p.setting), dots: true };
    }),
  });
  return [
    plot("Rate and error", "Distance, rms, mm", (p) => p.rms_mm, true),
    plot("Rate and quality", "D1 PSNR, dB", (p) => p.distortion.d1_psnr_db, false),
    plot("Rate and largest error", "Largest distance, mm", (p) => p.max_mm, true),
    plot("Rate and coding time", "Coding time a scan, ms", (p) => p.encode_ms_per_scan, true),
  ];
}

/** Bjontegaard differences as a table. */
export function rateTable({ bd_rates: rates, input, scans }: SweepReport): HTMLElement {
  const heads = ["Coder", "against", "Bytes at the same quality"];
  return h(
    "div",
    { class: "panel table-box", tabindex: "0", role: "region", "aria-label": "Bjontegaard differences" },
    h(
      "table",
      {},
      h("caption", {}, `Bjontegaard differences over ${scans} scans of ${input}`),
      h("thead", {}, h("tr", {}, ...heads.map((text) => h("th", { scope: "col" }, text)))),
      h(
        "tbody",
        {},
        ...rates.map(({ test, anchor, percent }) => {
          const sign = percent > 0 ? "+" : "−";
          const cells = [h("th", { scope: "row" }, test), h("td", {}, anchor)];
          return h("tr", {}, ...cells, h("td", { class: "number" }, `${sign}${decimal(Math.abs(percent))} %`));
        }),
      ),
    ),
  );
}
