import type { SessionSummary } from "../api/types";
import type { Context, View } from "../context";
import { button, h } from "../ui/dom";
import { bytes, clock, count, date, mm, ratio } from "../ui/format";
import { routeHash } from "../ui/route";
import { JobPanel } from "./job_panel";
import { SessionActions } from "./session_actions";

const STATE_WORDS: Record<SessionSummary["state"], string> = {
  recording: "recording",
  complete: "complete",
  unfinished: "unfinished",
  damaged: "damaged",
};

const STATE_HELP: Record<SessionSummary["state"], string> = {
  recording: "Being recorded now; it can be replayed when it is stopped.",
  complete: "Closed, indexed and checked.",
  unfinished: "Ended without being closed, as by a power cut. Recover makes a clean session of all complete groups.",
  damaged: "Some of it cannot be read. Verify says what; Recover saves the rest.",
};

const NUMBERS = ["Length", "Scans", "Size", "Ratio", "Tolerance"];

/** While something is recorded, sizes are read again so often. */
const REFRESH_MS = 5000;

/** All sessions and what can be done with them. */
export function sessionsView(context: Context): View {
  const heads = ["", "Session", ...NUMBERS, "State", "Recorded", "Actions"];
  const body = h("tbody");
  const table = h(
    "table",
    { class: "sessions" },
    h("caption", { class: "visually-hidden" }, "Recorded sessions"),
    h("thead", {}, h("tr", {}, ...heads.map(head))),
    body,
  );
  const empty = h(
    "p",
    { class: "notice", hidden: true },
    "No session yet. Record one in Operate, or copy .gv3 files into the session directory.",
  );
  const total = h("span", { class: "about" });
  const actions = new SessionActions(context, () => load());
  const jobs = new JobPanel(context);

  const load = async () => {
    const sessions = await context.announcer.attempt(() => context.client.sessions());
    if (!sessions) return;
    sessions.sort((a, b) => (b.created ?? "").localeCompare(a.created ?? ""));
    const focused = document.activeElement instanceof HTMLElement ? document.activeElement.dataset["focus"] : undefined;
    body.replaceChildren(...sessions.map((session) => row(context, session, actions)));
    empty.hidden = sessions.length > 0;
    table.hidden = sessions.length === 0;
    const size = sessions.reduce((sum, s) => sum + s.bytes, 0);
    total.textContent = `${count(sessions.length)} sessions, ${bytes(size)}`;
    if (focused) body.querySelector<HTMLElement>(`[data-focus="${CSS.escape(focused)}"]`)?.focus();
  };

  let state = context.feed.status?.state;
  const forget = context.feed.onStatus((status) => {
    if (status.state !== state && (status.state === "recording" || state === "recording")) void load();
    state = status.state;
  });
  const timer = setInterval(() => state === "recording" && void load(), REFRESH_MS);
  context.keys.setLocal([{ key: "u", does: "Read the list again", run: () => void load() }]);
  void load();
  const element = h(
    "main",
    { class: "sessions-view" },
    h(
      "header",
      { class: "view-head" },
      h("h1", {}, "Sessions"),
      total,
      h("span", { class: "spring" }),
      button("Refresh", () => void load()),
    ),
    jobs.element,
    h("div", { class: "panel table-box", tabindex: "0", role: "region", "aria-label": "Sessions" }, table, empty),
  );
  return {
    element,
    dispose: () => {
      clearInterval(timer);
      forget();
      jobs.dispose();
    },
  };
}

function head(text: string): HTMLElement {
  const hidden = h("span", { class: "visually-hidden" }, "Picture");
  return h("th", { scope: "col", class: [...NUMBERS, "Actions"].includes(text) ? "number" : "" }, text || hidden);
}

function row({ client }: Context, session: SessionSummary, actions: SessionActions): HTMLElement {
  const { name, state, segments } = session;
  const picture = h("img", { src: client.thumbnailUrl(name), alt: "", loading: "lazy", width: "64", height: "48" });
  picture.addEventListener("error", () => (picture.style.visibility = "hidden"));
  const playable = state !== "recording" && session.scans > 0;
  const parts = segments > 1 ? ` · ${segments} segments` : "";
  const raw = session.raw_bytes ? ` · ${bytes(session.raw_bytes)} raw` : "";
  const cell = (text: string, label: string) => h("td", { class: "number", "data-label": label }, text);
  return h(
    "tr",
    {},
    h("td", { class: "thumb" }, picture),
    h(
      "th",
      { scope: "row" },
      playable ? h("a", { href: routeHash("replay", name), "data-focus": `replay ${name}` }, name) : name,
      h("span", { class: "sub" }, `${session.mode}${parts}${raw}`),
    ),
    cell(clock(session.seconds), "Length"),
    cell(count(session.scans), "Scans"),
    cell(bytes(session.bytes), "Size"),
    cell(ratio(session.ratio), "Ratio"),
    cell(mm(session.tolerance_mm), "Tolerance"),
    h(
      "td",
      { "data-label": "State" },
      h("span", { class: "badge", "data-state": state, title: session.fault ?? STATE_HELP[state] }, STATE_WORDS[state]),
    ),
    h("td", { "data-label": "Recorded" }, session.created ? date(session.created) : "–"),
    h("td", { class: "actions" }, ...actions.buttons(session)),
  );
}
