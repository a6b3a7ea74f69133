import type { Job } from "../api/types";
import type { Context } from "../context";
import { button, h } from "../ui/dom";
import { bytes, words } from "../ui/format";
import { openDialog } from "../ui/dialog";

const KINDS: Record<Job["kind"], string> = {
  verify: "Verify",
  recover: "Recover",
  export: "Export",
  compare: "Compare",
};

/** Work in progress and what came of it. */
export class JobPanel {
  private readonly list = h("ul", { class: "jobs" });
  readonly element = h("section", { class: "panel", "aria-label": "Jobs", hidden: true }, this.list);
  private readonly forget: () => void;

  constructor(private readonly context: Context) {
    this.forget = context.jobs.onChange(() => this.show());
    this.show();
  }

  dispose(): void {
    this.forget();
  }

  private show(): void {
    const jobs = [...this.context.jobs.jobs.values()].reverse();
    this.element.hidden = jobs.length === 0;
    this.list.replaceChildren(...jobs.map((job) => this.line(job)));
  }

  private line(job: Job): HTMLElement {
    const { announcer, client, jobs } = this.context;
    const running = job.state === "running";
    const bar = job.total > 0 ? { max: job.total, value: job.done } : {};
    const name = `${KINDS[job.kind]} ${job.session}`;
    return h(
      "li",
      { "data-state": job.state },
      h("b", {}, name),
      running ? h("progress", { ...bar, "aria-label": name }) : h("span", {}, job.error || OUTCOMES[job.state]),
      running && job.total > 0 && h("span", { class: "sub" }, `${job.done} of ${job.total}`),
      job.state === "done" &&
        job.kind === "export" &&
        h(
          "a",
          { href: client.resultUrl(job.id), download: "", class: "button" },
          `Save ${job.result_bytes ? bytes(job.result_bytes) : ""}`,
        ),
      job.report != null && job.kind !== "compare" && button("Report", () => showReport(name, job.report)),
      h("span", { class: "spring" }),
      button(running ? "Cancel" : "Dismiss", () => void announcer.attempt(() => jobs.dismiss(job)), {
        "aria-label": `${running ? "Cancel" : "Dismiss"} ${name}`,
      }),
    );
  }
}

const OUTCOMES: Record<Job["state"], string> = { running: "", done: "done", failed: "failed", cancelled: "cancelled" };

/** A report as a list of names and values. */
function showReport(heading: string, report: unknown): void {
  const rows = typeof report === "object" && report !== null ? Object.entries(report) : [["result", report] as const];
  const text = (value: unknown) => (typeof value === "object" ? JSON.stringify(value) : String(value));
  const dialog = openDialog(
    heading,
    h("dl", { class: "report" }, ...rows.flatMap(([k, v]) => [h("dt", {}, words(k)), h("dd", {}, text(v))])),
    h(
      "div",
      { class: "dialog-buttons" },
      button("Close", () => dialog.close(), { autofocus: true }),
    ),
  );
}
