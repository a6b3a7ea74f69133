import type { Status } from "../api/types";
import { h, setText } from "../ui/dom";
import { bytes, count, decimal, duration, words } from "../ui/format";
import { Sparkline } from "../plot/sparkline";

/** Below this part of the disk's room over its floor, the bar warns. */
const LITTLE_TIME_S = 600;

/** Rates, latency, drops and disk. */
export class Gauges {
  private readonly scans = h("output", {});
  private readonly pictures = h("span", { class: "sub" });
  private readonly latency = h("output", {});
  private readonly tail = h("span", { class: "sub" });
  private readonly disk = h("output", {});
  private readonly room = h("span", { class: "sub" });
  private readonly dropped = h("output", {});
  private readonly causes = h("ul", { class: "causes" });
  private readonly rateLine = new Sparkline("Scans a second over the last minute");
  private readonly latencyLine = new Sparkline("Latency over the last minute");
  readonly element = h(
    "section",
    { class: "gauges", "aria-label": "Figures" },
    tile("Scans a second", this.scans, this.pictures, this.rateLine.element),
    tile("Latency, picture to surface", this.latency, this.tail, this.latencyLine.element),
    tile("Disk left", this.disk, this.room),
    tile("Dropped", this.dropped, this.causes),
  );

  show(status: Status): void {
    const running = status.state === "previewing" || status.state === "recording";
    const { p50, p99 } = status.latency_ms;
    setText(this.scans, running ? status.scans_per_second.toFixed(1) : "–");
    setText(this.pictures, running ? `${decimal(status.pictures_per_second)} pictures/s` : "");
    setText(this.latency, running && p50 ? `${count(p50)} ms` : "–");
    setText(this.tail, running && p99 ? `99 % within ${count(p99)} ms` : "");
    this.rateLine.add(running ? status.scans_per_second : null);
    this.latencyLine.add(running && p50 ? p50 : null);
    this.showDisk(status);
    this.showDrops(status);
  }

  private showDisk({ disk }: Status): void {
    const left = disk.seconds_left;
    setText(this.disk, left === null ? bytes(disk.free_bytes) : duration(left));
    const room =
      left === null ? `of ${bytes(disk.total_bytes)}` : `${bytes(disk.free_bytes)} of ${bytes(disk.total_bytes)}`;
    const full = disk.free_bytes <= disk.floor_bytes;
    const advice = " Delete sessions or move them away.";
    setText(this.room, full ? `${room}: below the floor of ${bytes(disk.floor_bytes)}.${advice}` : room);
    this.disk.classList.toggle("bad", full || (left !== null && left < LITTLE_TIME_S));
  }

  private showDrops({ drops, queues }: Status): void {
    const causes = Object.entries(drops).filter(([, n]) => n > 0);
    const total = causes.reduce((sum, [, n]) => sum + n, 0);
    setText(this.dropped, count(total));
    this.dropped.classList.toggle("bad", total > 0);
    const waiting = Object.entries(queues).map(([name, n]) => `${n} ${words(name)}`);
    const lines = [...causes.map(([cause, n]) => `${count(n)} ${words(cause)}`), `waiting: ${waiting.join(", ")}`];
    if (this.causes.childElementCount !== lines.length) {
      this.causes.replaceChildren(...lines.map((line) => h("li", {}, line)));
    }
    for (const [k, line] of lines.entries()) setText(this.causes.children[k]!, line);
  }
}

function tile(name: string, ...content: Node[]): HTMLElement {
  return h("div", { class: "panel tile" }, h("h2", {}, name), ...content);
}
