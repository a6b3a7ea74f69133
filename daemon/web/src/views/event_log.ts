import type { SessionEvent } from "../api/types";
import { eventWords } from "../replay/timeline";
import { h } from "../ui/dom";

const KEPT = 50;

/** What happened lately, newest first. */
export class EventLog {
  private readonly none = h("p", { class: "sub" }, "Nothing since this page was opened.");
  private readonly list = h("ol", { class: "events" });
  readonly element = h(
    "section",
    { class: "panel event-panel", "aria-label": "Events" },
    h("header", {}, h("h2", {}, "Events")),
    this.none,
    this.list,
  );

  add(event: SessionEvent): void {
    this.none.hidden = true;
    const time = new Date().toTimeString().slice(0, 8);
    const tick = event.tick === undefined ? "" : ` tick ${event.tick}`;
    this.list.prepend(h("li", { class: `event-${event.kind}` }, h("time", {}, time), `${tick} ${eventWords(event)}`));
    while (this.list.childElementCount > KEPT) this.list.lastElementChild?.remove();
  }
}
