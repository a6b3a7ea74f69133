import type { SessionDetail } from "../api/types";
import { h, setText } from "../ui/dom";
import { clock, words } from "../ui/format";

/** The bar of a replay: scrubbing, with keyframes, gaps and events marked. */
export class Timeline {
  private readonly slider = h("input", {
    type: "range",
    min: "0",
    step: "any",
    value: "0",
    "aria-label": "Time in the session",
    class: "timeline-slider",
  });
  private readonly marks = h("div", { class: "timeline-marks", "aria-hidden": "true" });
  private readonly now = h("span", { class: "timeline-now" });
  private readonly length = h("span", { class: "timeline-length" });
  readonly element = h(
    "div",
    { class: "timeline" },
    this.now,
    h("div", { class: "timeline-bar" }, this.slider, this.marks),
    this.length,
  );

  constructor(onSeek: (seconds: number) => void) {
    this.slider.addEventListener("input", () => onSeek(Number(this.slider.value)));
  }

  /** Lays the bar out for a session that lasts `seconds`, one step of the keys a scan. */
  describe(session: SessionDetail, seconds: number): void {
    this.slider.max = String(seconds);
    setText(this.length, clock(seconds, 2));
    const { first_tick: first, period_nanos: period } = session;
    const place = (tick: number) => `left: ${(((tick - first) * period * 1e-9) / (seconds || 1)) * 100}%`;
    const keys = session.groups.map((g) => h("i", { class: "key", style: place(g.key_tick) }));
    const events = session.events
      .filter((e) => e.tick !== undefined)
      .map((e) => h("i", { class: `event ${e.kind}`, style: place(e.tick!), title: eventWords(e) }));
    this.marks.replaceChildren(...(keys.length < 400 ? keys : []), ...events);
  }

  show(seconds: number): void {
    if (Math.abs(Number(this.slider.value) - seconds) > 1e-4) this.slider.value = String(seconds);
    setText(this.now, clock(seconds, 2));
    this.slider.setAttribute("aria-valuetext", `${seconds.toFixed(2)} seconds`);
  }
}

/** An event in one line: `drop: queue reconstruct, 3`. */
export function eventWords(event: Record<string, unknown> & { kind: string }): string {
  const known = ["cause", "source", "message", "device", "change", "text", "count", "ticks", "level", "state", "error"];
  const parts = known.filter((key) => event[key] != null).map((key) => words(String(event[key])));
  return parts.length ? `${words(event.kind)}: ${parts.join(", ")}` : words(event.kind);
}
