import type { Context } from "./context";
import type { SessionEvent, Status } from "./api/types";
import { button, h, setText } from "./ui/dom";
import { clock } from "./ui/format";
import { showHelp } from "./ui/help";
import { StaleMark } from "./ui/stale";
import { chooseTheme, currentTheme } from "./ui/theme";

const VIEWS = [
  ["operate", "Operate", "o"],
  ["sessions", "Sessions", "s"],
  ["replay", "Replay", "y"],
  ["measure", "Measure", "e"],
] as const;

/** What is around every view: names of the views, the scanner's state, the connection, theme and help. */
export class Shell {
  private readonly links = VIEWS.map(([view, name]) => h("a", { href: `#/${view}`, "data-view": view }, name));
  private readonly state = h("span", { class: "pill", "aria-live": "polite" });
  private readonly theme = button("", () => this.toggleTheme());
  private readonly place = h("div", { class: "view" });
  private readonly lost = h("p", { class: "connection", role: "alert", hidden: true });
  private readonly stale: StaleMark;
  readonly element: HTMLElement;

  constructor(private readonly context: Context) {
    this.stale = new StaleMark(() => context.feed.socket);
    this.element = h(
      "div",
      { class: "shell" },
      h(
        "header",
        { class: "bar" },
        h("a", { href: "#view", class: "skip", onclick: (event: Event) => this.skip(event) }, "To the content"),
        h("span", { class: "brand" }, "gv3"),
        h("nav", { "aria-label": "Views" }, ...this.links),
        h("span", { class: "spring" }),
        this.stale.element,
        this.state,
        this.theme,
        button("?", () => showHelp(context.keys), { "aria-label": "Keys", title: "Keys (?)" }),
      ),
      this.lost,
      this.place,
      context.announcer.element,
    );
    context.feed.onStatus((status) => this.showStatus(status));
    context.feed.onConnection(() => this.showConnection());
    context.feed.onEvent((event) => this.tell(event));
    context.keys.addGlobal(
      ...VIEWS.map(([view, name, key]) => ({ key, does: name, run: () => (location.hash = `#/${view}`) })),
      { key: "t", does: "Dark or light", run: () => this.toggleTheme() },
      { key: "?", does: "This help", run: () => showHelp(context.keys) },
    );
    this.nameTheme();
  }

  /** Puts a view in place. */
  showView(name: string, element: HTMLElement): void {
    for (const link of this.links) {
      if (link.dataset["view"] === name) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    document.title = `${VIEWS.find(([view]) => view === name)![1]} · gv3`;
    element.id = "view";
    element.tabIndex = -1;
    this.place.replaceChildren(element);
  }

  private skip(event: Event): void {
    event.preventDefault();
    document.getElementById("view")?.focus();
  }

  private showStatus({ state, recording }: Status): void {
    this.state.dataset["state"] = state;
    // A running clock would be read out twice a second.
    this.state.setAttribute("aria-live", recording ? "off" : "polite");
    setText(this.state, recording ? `REC ${clock(recording.seconds, 0)}` : state);
  }

  /** What the scanner's user must hear of in any view. */
  private tell({ kind, message, ticks }: SessionEvent): void {
    if (kind === "gap") this.context.announcer.say(`Scans come again after a gap of ${String(ticks)}`);
    if (kind !== "fault") return;
    const isGone = /disconnected/.test(String(message));
    const advice = isGone ? ". Plug it in again: a recording waits for it and goes on after a gap." : "";
    this.context.announcer.fault(new Error(`${String(message)}${advice}`));
  }

  private showConnection(): void {
    const waiting = this.context.feed.socket.state === "waiting";
    if (this.context.feed.socket.state === "open") this.lost.hidden = true;
    if (!waiting) return;
    this.lost.hidden = false;
    setText(
      this.lost,
      "No connection to the daemon; trying again. Recording goes on without this page. If this stays, see whether gv3 serve runs (systemctl status gv3).",
    );
  }

  private toggleTheme(): void {
    chooseTheme(currentTheme() === "dark" ? "light" : "dark");
    this.nameTheme();
  }

  private nameTheme(): void {
    const other = currentTheme() === "dark" ? "Light" : "Dark";
    setText(this.theme, other);
    this.theme.setAttribute("aria-label", `${other} theme`);
  }
}
