import { button, h } from "../ui/dom";
import type { Shortcut } from "../ui/keys";
import type { Playback } from "./playback";

/** Speeds offered, times real time. */
export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4] as const;

/** The speed one step up or down. */
export function neighbourSpeed(speed: number, by: 1 | -1): number {
  const at = SPEEDS.reduce((best, s, k) => (Math.abs(s - speed) < Math.abs(SPEEDS[best]! - speed) ? k : best), 0);
  return SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, at + by))]!;
}

/** Buttons of a replay: play, steps, speed, direction, loop. */
export class Transport {
  private readonly play = button("Play", () => this.toggle(), { class: "primary play" });
  private readonly reverse = button("Reverse", () => this.toggleReverse(), { "aria-pressed": "false" });
  private readonly loop = button("Loop", () => this.toggleLoop(), { "aria-pressed": "true" });
  private readonly speed = h(
    "select",
    { "aria-label": "Speed" },
    ...SPEEDS.map((s) => h("option", { value: s, selected: s === 1 }, `${s}×`)),
  );
  readonly element = h(
    "div",
    { class: "transport", role: "group", "aria-label": "Playing" },
    button("|◀", () => this.with((p) => p.seek(0)), { "aria-label": "To the beginning", title: "Home" }),
    button("◀ scan", () => this.step(-1), { "aria-label": "One scan back", title: "," }),
    this.play,
    button("scan ▶", () => this.step(1), { "aria-label": "One scan on", title: "." }),
    button("▶|", () => this.with((p) => p.seek(Infinity)), { "aria-label": "To the end", title: "End" }),
    h("label", { class: "field inline" }, h("span", {}, "Speed"), this.speed),
    this.reverse,
    this.loop,
  );

  /** `periodSeconds`: time from scan to scan. */
  constructor(
    private readonly playback: () => Playback | null,
    private readonly periodSeconds: () => number,
  ) {
    this.speed.addEventListener("change", () => this.with((p) => p.setSpeed(Number(this.speed.value))));
  }

  /** Shows what the playback does now. */
  update(): void {
    const p = this.playback();
    if (!p) return;
    const label = p.playing ? "Pause" : "Play";
    if (this.play.textContent !== label) this.play.textContent = label;
    this.reverse.setAttribute("aria-pressed", String(p.reverse));
    this.loop.setAttribute("aria-pressed", String(p.loop));
    this.speed.value = String(p.speed);
  }

  shortcuts(): Shortcut[] {
    const speed = (by: 1 | -1) => () => this.with((p) => p.setSpeed(neighbourSpeed(p.speed, by)));
    return [
      { key: " ", does: "Play or pause", run: () => this.toggle() },
      { key: ",", does: "One scan back", run: () => this.step(-1) },
      { key: ".", does: "One scan on", run: () => this.step(1) },
      { key: "Home", does: "To the beginning", run: () => this.with((p) => p.seek(0)) },
      { key: "End", does: "To the end", run: () => this.with((p) => p.seek(Infinity)) },
      { key: "[", does: "Slower", run: speed(-1) },
      { key: "]", does: "Faster", run: speed(1) },
      { key: "b", does: "Backwards or forwards", run: () => this.toggleReverse() },
      { key: "l", does: "Loop or stop at the end", run: () => this.toggleLoop() },
    ];
  }

  private with(act: (playback: Playback) => void): void {
    const playback = this.playback();
    if (playback) act(playback);
  }

  private toggle(): void {
    this.with((p) => (p.playing ? p.pause() : p.play()));
  }

  private toggleReverse(): void {
    this.with((p) => p.setReverse(!p.reverse));
  }

  private toggleLoop(): void {
    this.with((p) => p.setLoop(!p.loop));
  }

  /** To the next scan: the nearest multiple of the period, then one on. */
  private step(by: 1 | -1): void {
    this.with((p) => {
      if (p.playing) p.pause();
      const period = this.periodSeconds();
      p.seek((Math.round(p.timeSeconds / period) + by) * period);
    });
  }
}
