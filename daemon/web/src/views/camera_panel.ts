import { PICTURE_VIEWS, readPicture, type PictureView } from "../api/picture_message";
import { ReconnectingSocket } from "../api/socket";
import type { Status } from "../api/types";
import type { Context } from "../context";
import { choices, h, setText } from "../ui/dom";
import { percent } from "../ui/format";
import type { Shortcut } from "../ui/keys";
import { StaleMark } from "../ui/stale";

const FPS = 10;
const NAMES: Record<PictureView, string> = {
  camera: "Camera",
  fringe: "Fringes",
  modulation: "Modulation",
  phase: "Phase",
  mask: "Mask",
};
const EXPOSURE_WORDS = {
  ok: "Exposure is right.",
  too_bright: "Too bright: shorten the exposure, close the aperture, or dim the projector.",
  too_dark: "Too dark: lengthen the exposure, open the aperture, or come nearer.",
};

/** The camera's picture and what is computed from it. */
export class CameraPanel {
  private readonly canvas = h("canvas", { role: "img", "aria-label": "Camera picture" });
  private readonly off = h("p", { class: "empty" }, "Scanner off");
  private readonly exposure = h("p", { class: "exposure" });
  private readonly views = choices(
    "Picture",
    PICTURE_VIEWS.map((view) => [view, NAMES[view]] as const),
    "camera",
    (view) => this.open(view),
  );
  private readonly stale: StaleMark;
  private readonly forget: () => void;
  private socket: ReconnectingSocket | null = null;
  private newest: ArrayBuffer | null = null;
  private drawing = false;
  private shownView: PictureView = "camera";
  readonly element: HTMLElement;

  constructor(
    private readonly context: Context,
    private readonly isOff: () => boolean,
  ) {
    this.stale = new StaleMark(() => this.socket, isOff);
    this.element = h(
      "section",
      { class: "panel picture", "aria-label": "Camera" },
      h("header", {}, this.views.element, h("span", { class: "spring" }), this.stale.element),
      h("div", { class: "picture-box" }, this.canvas, this.off),
      this.exposure,
    );
    this.forget = context.feed.onStatus((status) => this.showStatus(status));
    this.open("camera");
  }

  dispose(): void {
    this.forget();
    this.stale.dispose();
    this.socket?.close();
  }

  shortcuts(): Shortcut[] {
    return PICTURE_VIEWS.map((view, k) => ({
      key: String(k + 1),
      does: `Picture: ${NAMES[view].toLowerCase()}`,
      run: () => {
        this.views.select(view);
        this.open(view);
      },
    }));
  }

  private open(view: PictureView): void {
    this.socket?.close();
    this.newest = null;
    this.shownView = view;
    this.canvas.setAttribute("aria-label", `${NAMES[view]} picture`);
    this.socket = new ReconnectingSocket(this.context.client.socketUrl(`live/picture?view=${view}&fps=${FPS}`), {
      message: (data) => {
        if (typeof data === "string") return;
        this.newest = data;
        void this.draw(view);
      },
    });
  }

  /** Draws the newest picture; those that come meanwhile replace each other. */
  private async draw(view: PictureView): Promise<void> {
    if (this.drawing) return;
    this.drawing = true;
    while (this.newest) {
      const data = this.newest;
      this.newest = null;
      try {
        const picture = await createImageBitmap(readPicture(data).image);
        if (view === this.shownView) this.paint(picture);
        picture.close();
      } catch (error) {
        this.context.announcer.fault(error);
      }
    }
    this.drawing = false;
  }

  private paint(picture: ImageBitmap): void {
    if (this.canvas.width !== picture.width) this.canvas.width = picture.width;
    if (this.canvas.height !== picture.height) this.canvas.height = picture.height;
    this.canvas.getContext("2d")?.drawImage(picture, 0, 0);
  }

  private showStatus({ exposure }: Status): void {
    const off = this.isOff();
    this.off.hidden = !off;
    this.canvas.classList.toggle("dimmed", off);
    this.exposure.hidden = off || !exposure;
    if (!exposure) return;
    this.exposure.dataset["hint"] = exposure.hint;
    const shares = `${percent(exposure.saturated_share)} saturated, ${percent(exposure.dark_share)} dark.`;
    setText(this.exposure, `${EXPOSURE_WORDS[exposure.hint]} ${shares}`);
  }
}
