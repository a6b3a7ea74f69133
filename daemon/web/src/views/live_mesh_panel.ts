import { ReconnectingSocket } from "../api/socket";
import type { Context } from "../context";
import { Legend } from "../scene/legend";
import { MeshStream } from "../scene/mesh_stream";
import type { Look } from "../scene/surface_material";
import { Viewer } from "../scene/viewer";
import { button, choices, h, setText } from "../ui/dom";
import { count } from "../ui/format";
import { StaleMark } from "../ui/stale";

/** Live scans a second and their size: enough to judge by, little enough to leave the daemon alone. */
const FPS = 15;
const MOST_VERTICES = 20_000;
const LOOKS = [
  ["shaded", "Shaded"],
  ["textured", "Textured"],
  ["wireframe", "Wires"],
  ["depth", "Depth"],
] as const satisfies readonly (readonly [Look, string])[];

/** The newest scan as a surface. */
export class LiveMeshPanel {
  private readonly viewer = new Viewer("Live surface");
  private readonly legend = new Legend();
  private readonly figures = h("p", { class: "figures" });
  private readonly off = h("p", { class: "empty" }, "Scanner off");
  private readonly stale: StaleMark;
  private readonly socket: ReconnectingSocket;
  private readonly forget: () => void;
  readonly element: HTMLElement;

  constructor(context: Context, isOff: () => boolean) {
    const stream = new MeshStream(
      ({ message, picture }) => {
        if (!this.viewer.show(message, picture)) picture?.close();
        this.explainColours();
        setText(this.figures, `${count(message.vertices)} vertices shown`);
      },
      (error) => context.announcer.fault(error),
    );
    this.socket = new ReconnectingSocket(
      context.client.socketUrl(`live/mesh?fps=${FPS}&max_vertices=${MOST_VERTICES}`),
      { message: (data) => stream.receive(data) },
    );
    this.stale = new StaleMark(() => this.socket, isOff);
    const looks = choices("Look of the surface", LOOKS, "shaded", (look) => this.setLook(look));
    this.viewer.setLook("shaded");
    this.viewer.element.append(this.off, this.legend.element);
    this.element = h(
      "section",
      { class: "panel live-mesh", "aria-label": "Live surface" },
      h(
        "header",
        {},
        looks.element,
        button("Whole", () => this.viewer.orbit.reset(), { title: "Show all of it from the front (0)" }),
        h("span", { class: "spring" }),
        this.stale.element,
      ),
      this.viewer.element,
      this.figures,
    );
    this.forget = context.feed.onStatus(() => {
      this.off.hidden = !isOff();
      this.viewer.canvas.classList.toggle("dimmed", isOff());
    });
  }

  private setLook(look: Look): void {
    this.viewer.colours.reset();
    this.viewer.setLook(look);
    this.legend.hide();
  }

  private explainColours(): void {
    const { surface, colours } = this.viewer;
    if (surface.isColoured && colours.span) this.legend.show("Depth, mm", ...colours.span);
  }

  dispose(): void {
    this.forget();
    this.stale.dispose();
    this.socket.close();
    this.viewer.dispose();
  }
}
