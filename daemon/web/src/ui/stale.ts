import type { ReconnectingSocket } from "../api/socket";
import { h, setText } from "./dom";

/** How old data may be before it is called stale. */
const STALE_AFTER_MS = 2000;
const LOOK_EVERY_MS = 500;

/** A mark on something live: hidden while data comes, then how old it is and what is being done. */
export class StaleMark {
  readonly element = h("span", { class: "stale", hidden: true });
  private readonly since = performance.now();
  private readonly timer = setInterval(() => this.update(), LOOK_EVERY_MS);

  /** `waiting`: whether there is a reason why nothing should come now, as when the scanner is off. */
  constructor(
    private readonly socket: () => ReconnectingSocket | null,
    private readonly waiting: () => boolean = () => false,
  ) {}

  /** Seconds without news; 0 while data is fresh. */
  staleSeconds(now = performance.now()): number {
    const socket = this.socket();
    if (!socket) return 0;
    const age = now - (socket.lastMessageMs ?? this.since);
    return age < STALE_AFTER_MS ? 0 : Math.floor(age / 1000);
  }

  update(): void {
    const socket = this.socket();
    const seconds = this.staleSeconds();
    const broken = socket !== null && socket.state !== "open";
    this.element.hidden = seconds === 0 || (!broken && this.waiting());
    if (!this.element.hidden) {
      setText(this.element, `stale since ${seconds} s${broken ? ", reconnecting" : ""}`);
    }
  }

  dispose(): void {
    clearInterval(this.timer);
  }
}
