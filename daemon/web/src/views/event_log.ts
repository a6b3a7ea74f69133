import type { SessionEvent } from "../api/types";
import { eventWords } from "../replay/timeline";
import { h } from "../ui/dom";

const KEPT = 50;

/** What happened lately, newest first. */
export class EventLog {
  private readonly list = h("ol", { class: "events" });
  readonly element = h(
    "section",
    { class: "panel", "aria-label": "Events", hidden: true },
    h("header", {}, h("h2", {}, "Events")),
    this.list,
  );

  add(event: SessionEvent): void {
    this.element.hidden = false;
    const time = new Date().toTimeString().slice(0, 8);
    const tick = event.tick === undefined ? "" : ` tick ${event.tick}`;
    this.list.prepend(h("li", { class: event.kind }, h("time", {}, time), `${tick} ${eventWords(event)}`));
    while (this.list.childElementCount > KEPT) this.list.lastElementChild?.remove();
  }
}
