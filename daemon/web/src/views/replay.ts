import type { SessionDetail } from "../api/types";
import type { Context, View } from "../context";
import type { ReplayOutput } from "../replay/channel";
import { PairPlayer } from "../replay/pair_player";
import type { Playback } from "../replay/playback";
import { Player } from "../replay/player";
import { Timeline } from "../replay/timeline";
import { Transport } from "../replay/transport";
import { ColourRange } from "../scene/colour_range";
import { Legend } from "../scene/legend";
import { Orbit } from "../scene/orbit";
import type { StereoMode } from "../scene/stereo";
import { scalarsOf, type Look } from "../scene/surface_material";
import { Viewer } from "../scene/viewer";
import type { DecodedMesh } from "../scene/mesh_stream";
import { button, choices, dropdown, h, setText } from "../ui/dom";
import { download } from "../ui/download";
import { bytes, count, mm, ratio } from "../ui/format";
import { readRoute, routeHash, type Route } from "../ui/route";
import { StaleMark } from "../ui/stale";

const LOOK_NAMES = [
  ["textured", "Textured"],
  ["shaded", "Shaded"],
  ["wireframe", "Wires"],
  ["skin", "Skin tone"],
  ["depth", "Depth"],
  ["error", "Error"],
  ["motion", "Motion"],
] as const satisfies readonly (readonly [Look, string])[];

const STEREO_NAMES = [
  ["mono", "One eye"],
  ["anaglyph", "Red-cyan"],
  ["side_by_side", "Side by side"],
] as const satisfies readonly (readonly [StereoMode, string])[];

/** A look without its numbers for so long has none here; before, they may be on their way. */
const SCALARS_PATIENCE_MS = 1000;

/** Replays a session, or two in lock-step. */
export function replayView(context: Context, route: Route): View {
  return new ReplayView(context, route);
}

class ReplayView implements View {
  readonly element = h("main", { class: "replay" });
  private readonly orbit = new Orbit();
  private readonly colours = new ColourRange();
  private readonly viewers: Viewer[] = [];
  private readonly captions: HTMLElement[] = [];
  private readonly legend = new Legend();
  private readonly timeline = new Timeline((seconds) => this.playback?.seek(seconds));
  private readonly transport: Transport;
  private readonly rate = h("span", { class: "rate" });
  private readonly stale = new StaleMark(
    () => this.playback?.socket ?? null,
    () => !this.playback?.playing,
  );
  private playback: Playback | null = null;
  private sessions: SessionDetail[] = [];
  private look: Look = "textured";
  private lookMs = 0;
  private output: ReplayOutput = "scan";
  private drawnBefore = 0;
  private readonly timer = setInterval(() => this.measureRate(), 1000);
  private gone = false;

  constructor(
    private readonly context: Context,
    private readonly route: Route,
  ) {
    this.output = route.query.get("as") === "mesh" ? "mesh" : "scan";
    this.transport = new Transport(
      () => this.playback,
      () => (this.sessions[0]?.period_nanos ?? 33_333_333) * 1e-9,
    );
    context.keys.setLocal([
      ...this.transport.shortcuts(),
      ...LOOK_NAMES.map(([look, name], k) => ({ key: String(k + 1), does: name, run: () => this.setLook(look) })),
      { key: "x", does: "Scan or tracked mesh", run: () => this.setOutput(this.output === "scan" ? "mesh" : "scan") },
    ]);
    void context.announcer.attempt(() => this.open());
  }

  dispose(): void {
    this.gone = true;
    clearInterval(this.timer);
    this.stale.dispose();
    this.playback?.close();
    for (const viewer of this.viewers) viewer.dispose();
  }

  private async open(): Promise<void> {
    const all = await this.context.client.sessions();
    const playable = all.filter((s) => s.scans > 0).map((s) => s.name);
    const { name, query } = this.route;
    if (this.gone) return;
    if (!name) return this.offer(playable);
    const names = [name, query.get("with")].filter((n): n is string => !!n);
    this.sessions = await Promise.all(names.map((n) => this.context.client.session(n)));
    if (this.gone) return;
    this.build(playable);
    this.connect(Number(query.get("t")) || 0);
    this.playback?.play();
  }

  /** Nothing chosen yet. */
  private offer(names: string[]): void {
    const links = names.map((n) => h("li", {}, h("a", { href: routeHash("replay", n) }, n)));
    this.element.replaceChildren(
      h("h1", {}, "Replay"),
      links.length
        ? h("div", { class: "panel" }, h("p", {}, "Choose a session:"), h("ul", { class: "links" }, ...links))
        : h("p", { class: "notice" }, "No session has been recorded yet. Record one in Operate."),
    );
  }

  private build(names: string[]): void {
    for (const session of this.sessions) {
      const viewer = new Viewer(`Surface of session ${session.name}`, this.orbit, this.colours);
      const caption = h("figcaption", {});
      this.viewers.push(viewer);
      this.captions.push(caption);
    }
    const figures = this.viewers.map((v, k) => h("figure", { class: "stage" }, v.element, this.captions[k]!));
    const stages = h("div", { class: `stages sides-${figures.length}` }, ...figures, this.legend.element);
    this.element.replaceChildren(
      h("h1", { class: "visually-hidden" }, `Replay of ${this.sessions.map((s) => s.name).join(" and ")}`),
      this.toolbar(names),
      stages,
      this.player(),
    );
    for (const [k, s] of this.sessions.entries()) {
      const tolerance = s.tolerance_mm != null ? ` · tolerance ${mm(s.tolerance_mm)}` : "";
      const smaller = s.ratio ? ` · ${ratio(s.ratio)}` : "";
      const text = `${s.name} · ${count(s.scans)} scans · ${bytes(s.bytes)}${smaller}${tolerance}`;
      setText(this.captions[k]!, text);
    }
    this.timeline.describe(this.sessions[0]!, this.seconds());
    this.setLook(this.look);
  }

  private looks = choices("Look of the surface", LOOK_NAMES, this.look, (look) => this.setLook(look));
  private outputs = choices(
    "What is shown",
    [
      ["scan", "Scan"],
      ["mesh", "Tracked mesh"],
    ] as const,
    this.output,
    (output) => this.setOutput(output),
  );

  private toolbar(names: string[]): HTMLElement {
    const [first, second] = this.sessions;
    const options = names.map((n) => [n, n] as const);
    const session = dropdown("Session", options, first!.name, (n) => this.go(n, second?.name));
    const beside = dropdown("Beside", [["", "none"], ...options] as const, second?.name ?? "", (n) =>
      this.go(first!.name, n || undefined),
    );
    const stereo = choices("Stereo", STEREO_NAMES, "mono", (mode) => {
      for (const viewer of this.viewers) viewer.setStereo(mode);
    });
    this.outputs.select(this.output);
    return h(
      "div",
      { class: "toolbar", role: "toolbar", "aria-label": "Replay" },
      session.element,
      beside.element,
      this.outputs.element,
      this.looks.element,
      stereo.element,
    );
  }

  /** Below the surface, where there is room at any width. */
  private player(): HTMLElement {
    const line = h(
      "div",
      { class: "player-line" },
      this.transport.element,
      h("span", { class: "spring" }),
      this.stale.element,
      this.rate,
      button("Whole", () => this.orbit.reset(), { title: "Show all of it from the front (0)" }),
      button("PNG", () => void this.savePicture(), { title: "Save the picture" }),
    );
    return h("div", { class: "panel player" }, this.timeline.element, line);
  }

  private go(name: string, other?: string): void {
    const query: Record<string, string> = { t: (this.playback?.timeSeconds ?? 0).toFixed(3) };
    if (other) query["with"] = other;
    if (this.output === "mesh") query["as"] = "mesh";
    location.hash = routeHash("replay", name, query);
  }

  private seconds(): number {
    return Math.max(...this.sessions.map((s) => s.seconds));
  }

  private connect(startSeconds: number): void {
    const before = this.playback;
    before?.close();
    const { client, announcer } = this.context;
    const fault = (error: unknown) => announcer.fault(error);
    const changed = () => this.changed();
    const sides = this.sessions.map((s) => ({ session: s.name, output: this.output, lengthSeconds: s.seconds }));
    const first = sides[0]!;
    this.playback =
      sides.length > 1
        ? new PairPlayer(client, sides, startSeconds, {
            mesh: (side, mesh, isLate) => this.show(side, mesh, isLate),
            changed,
            fault,
          })
        : new Player(client, first.session, this.output, first.lengthSeconds, startSeconds, {
            mesh: (mesh, isLate) => this.show(0, mesh, isLate),
            changed,
            fault,
          });
    if (!before) return;
    this.playback.setSpeed(before.speed);
    this.playback.setReverse(before.reverse);
    this.playback.setLoop(before.loop);
    this.playback.setScalars(scalarsOf(this.look));
    if (before.playing) this.playback.play();
  }

  private setOutput(output: ReplayOutput): void {
    this.output = output;
    this.outputs.select(output);
    this.connect(this.playback?.timeSeconds ?? 0);
    const { name, query } = readRoute(location.hash);
    query.set("as", output);
    history.replaceState(null, "", routeHash("replay", name, Object.fromEntries(query)));
  }

  private setLook(look: Look): void {
    this.look = look;
    this.lookMs = performance.now();
    this.colours.reset();
    this.looks.select(look);
    for (const viewer of this.viewers) viewer.setLook(look);
    this.playback?.setScalars(scalarsOf(look));
    this.legend.hide();
  }

  private show(side: number, { message, picture }: DecodedMesh, isLate: boolean): void {
    const viewer = this.viewers[side];
    if (!viewer?.show(message, picture, isLate)) {
      picture?.close();
      return;
    }
    if (side > 0 || isLate) return;
    this.explainColours(viewer);
  }

  private explainColours({ surface }: Viewer): void {
    if (scalarsOf(this.look) === "none") return;
    const name = LOOK_NAMES.find(([look]) => look === this.look)![1];
    if (surface.isColoured) this.legend.show(`${name}, mm`, ...(this.colours.span ?? [0, 1]));
    else if (performance.now() - this.lookMs > SCALARS_PATIENCE_MS)
      this.legend.note(
        this.look === "motion" ? "Motion is known of the tracked mesh only." : `${name} is not known here.`,
      );
  }

  private changed(): void {
    if (!this.playback) return;
    this.timeline.show(this.playback.timeSeconds);
    this.transport.update();
  }

  private measureRate(): void {
    const drawn = this.viewers[0]?.drawn ?? 0;
    const rate = this.playback?.playing ? `${drawn - this.drawnBefore} pictures/s · ` : "";
    setText(this.rate, `${rate}${count(this.viewers[0]?.vertices ?? 0)} vertices`);
    this.drawnBefore = drawn;
  }

  private async savePicture(): Promise<void> {
    for (const [k, viewer] of this.viewers.entries()) {
      const picture = await viewer.picture();
      if (picture) download(`${this.sessions[k]!.name}-${this.look}.png`, "image/png", picture);
    }
  }
}
