import type { CompareReport, MeasureReport, ReportName, SessionSummary, SweepReport } from "../api/types";
import type { Context, View } from "../context";
import { comparePlots, measurePlots, rateTable, sessionPlots, sweepPlots } from "../measure_plots";
import { Plot } from "../plot/plot";
import type { PlotData } from "../plot/series";
import { button, dropdown, h } from "../ui/dom";
import { mm } from "../ui/format";
import { routeHash, type Route } from "../ui/route";
import { JobPanel } from "./job_panel";

/** Curves of sessions, comparisons and reports. */
export function measureView(context: Context, route: Route): View {
  return new MeasureView(context, route);
}

class MeasureView implements View {
  private readonly plots: Plot[] = [];
  private readonly body = h("div", { class: "plots" });
  private readonly jobs: JobPanel;
  private readonly choice = h("div", { class: "toolbar", role: "toolbar", "aria-label": "What to measure" });
  readonly element: HTMLElement;
  private gone = false;

  constructor(
    private readonly context: Context,
    private readonly route: Route,
  ) {
    this.jobs = new JobPanel(context);
    this.element = h(
      "main",
      { class: "measure" },
      h("header", { class: "view-head" }, h("h1", {}, "Measure")),
      this.choice,
      this.jobs.element,
      this.body,
    );
    context.keys.setLocal([]);
    void context.announcer.attempt(() => this.open());
  }

  dispose(): void {
    this.gone = true;
    this.jobs.dispose();
    this.clear();
  }

  private async open(): Promise<void> {
    const { client } = this.context;
    const [all, reports] = await Promise.all([client.sessions(), client.reports()]);
    if (this.gone) return;
    const sessions = all.filter((s) => s.scans > 0 && s.state !== "recording");
    this.offer(sessions, reports);
    const report = this.route.query.get("report");
    if (report) return this.openReport(report, reports.find((r) => r.name === report)?.kind ?? "measure");
    const name = this.route.name || sessions[0]?.name;
    if (name) return this.openSession(name);
    this.body.replaceChildren(h("p", { class: "notice" }, "Nothing to measure yet. Record a session in Operate."));
  }

  private offer(sessions: SessionSummary[], reports: ReportName[]): void {
    const report = this.route.query.get("report") ?? "";
    const name = report ? "" : this.route.name || (sessions[0]?.name ?? "");
    const names = sessions.map((s) => [s.name, s.name] as const);
    const go = (hash: string) => (location.hash = hash);
    const session = dropdown("Session", report ? ([["", "–"], ...names] as const) : names, name, (n) =>
      go(routeHash("measure", n)),
    );
    const others = names.filter(([n]) => n !== name);
    const other = dropdown("Against", others, others[0]?.[0] ?? "", () => undefined);
    const compare = button("Compare", () => void this.compare(name, other.select.value), {
      disabled: !name || others.length === 0,
    });
    const files = reports.map((r) => [r.name, `${r.name} (${r.kind})`] as const);
    const reportList = dropdown(
      "Report",
      [["", reports.length ? "none" : "none yet"], ...files] as const,
      report,
      (r) => go(r ? routeHash("measure", "", { report: r }) : routeHash("measure")),
    );
    reportList.select.disabled = reports.length === 0;
    const help =
      "Reports are what gv3 sweep and gv3 measure --json leave in the folder “reports” of the session directory.";
    this.choice.replaceChildren(
      session.element,
      other.element,
      compare,
      reportList.element,
      h("span", { class: "sub" }, help),
    );
  }

  private async openSession(name: string): Promise<void> {
    const { client } = this.context;
    const [detail, curve] = await Promise.all([client.session(name), client.curve(name)]);
    if (this.gone) return;
    this.showPlots(sessionPlots(detail, curve));
  }

  private async compare(name: string, other: string): Promise<void> {
    const { announcer, client, jobs } = this.context;
    const job = await announcer.attempt(async () => jobs.follow(await client.compare(name, other)));
    if (!job || this.gone) return;
    if (job.state === "failed") announcer.fault(new Error(job.error ?? "The comparison failed."));
    if (job.state !== "done") return;
    const report = (job.report ?? (await announcer.attempt(() => client.result(job.id)))) as CompareReport | null;
    if (!report) return;
    const all = `All scans: rms ${mm(report.rms_mm_all)}, 95 % within ${mm(report.p95_mm_all)}.`;
    this.showPlots(comparePlots(name, other, report), h("p", { class: "summary" }, all), true);
    announcer.say(`${name} against ${other}: ${all}`);
  }

  private async openReport(name: string, kind: ReportName["kind"]): Promise<void> {
    const report = await this.context.client.report(name);
    if (this.gone) return;
    if (kind === "sweep") this.showPlots(sweepPlots(report as SweepReport), rateTable(report as SweepReport));
    else this.showPlots(measurePlots(report as MeasureReport));
  }

  /** Shows plots; `keep` leaves those that are there below. */
  private showPlots(data: PlotData[], note?: HTMLElement, keep = false): void {
    if (!keep) this.clear();
    const plots = data.map((d) => new Plot(d));
    this.plots.push(...plots);
    const nodes = [...plots.map((p) => p.element), ...(note ? [note] : [])];
    if (keep) this.body.prepend(...nodes);
    else this.body.replaceChildren(...nodes);
  }

  private clear(): void {
    for (const plot of this.plots) plot.dispose();
    this.plots.length = 0;
  }
}
