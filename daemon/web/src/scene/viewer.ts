import { Color, PerspectiveCamera, Scene, WebGLRenderer } from "three";
import type { MeshMessage } from "../api/mesh_message";
import { h } from "../ui/dom";
import { themeColour } from "../ui/theme";
import { ColourRange } from "./colour_range";
import { Orbit } from "./orbit";
import { bindOrbit } from "./orbit_input";
import { renderStereo, type StereoMode } from "./stereo";
import { messageBox, Surface } from "./surface";
import type { Look } from "./surface_material";

/** Sharper costs more than it shows. */
const MOST_PIXELS_PER_POINT = 1.5;

/** A canvas with a surface on it that can be turned, moved and zoomed. Draws only when something changed. */
export class Viewer {
  readonly canvas = h("canvas", { tabindex: "0", role: "img", class: "surface" });
  readonly element = h("div", { class: "viewer" }, this.canvas);
  readonly surface: Surface;
  /** Drawn pictures of the surface, for rates. */
  drawn = 0;
  /** Vertices of the surface shown. */
  vertices = 0;
  private readonly renderer: WebGLRenderer | null;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera();
  private readonly resize = new ResizeObserver(() => this.requestDraw());
  private readonly forget: (() => void)[] = [];
  private stereo: StereoMode = "mono";
  private requested = 0;

  /** `label` says what is seen to those who do not see it. */
  constructor(
    label: string,
    readonly orbit = new Orbit(),
    readonly colours = new ColourRange(),
  ) {
    this.surface = new Surface(colours);
    this.canvas.setAttribute("aria-label", `${label}. Arrow keys turn it, plus and minus zoom, 0 shows all.`);
    this.renderer = makeRenderer(this.canvas);
    if (!this.renderer) {
      this.element.append(h("p", { class: "notice" }, "This browser has no WebGL 2, so surfaces cannot be drawn."));
      return;
    }
    this.scene.add(this.surface.object);
    bindOrbit(this.canvas, this.orbit);
    const theme = () => this.applyTheme();
    addEventListener("gv3-theme", theme);
    this.forget.push(
      () => removeEventListener("gv3-theme", theme),
      this.orbit.onChange(() => this.requestDraw()),
      this.colours.onChange(() => this.requestDraw()),
    );
    this.resize.observe(this.element);
    this.applyTheme();
  }

  /** Shows a mesh, or only takes it in when it is late; the first one is looked at from the front. */
  show(message: MeshMessage, picture: ImageBitmap | null, isLate = false): boolean {
    if (!this.surface.update(message, picture)) return false;
    this.vertices = message.vertices;
    if (isLate) return true;
    if (!this.orbit.fitted && message.vertices > 0) this.orbit.fit(messageBox(message));
    this.requestDraw();
    return true;
  }

  setLook(look: Look): void {
    this.surface.setLook(look);
    this.requestDraw();
  }

  setStereo(mode: StereoMode): void {
    this.stereo = mode;
    this.surface.setGrey(mode === "anaglyph");
    this.requestDraw();
  }

  /** The picture as a PNG. */
  picture(): Promise<Blob | null> {
    this.draw();
    return new Promise((resolve) => this.canvas.toBlob(resolve));
  }

  dispose(): void {
    cancelAnimationFrame(this.requested);
    this.resize.disconnect();
    for (const forget of this.forget) forget();
    this.surface.dispose();
    this.renderer?.dispose();
    this.renderer?.forceContextLoss();
  }

  private applyTheme(): void {
    const ground = new Color(themeColour("--scene") || "#000");
    const wire = new Color(themeColour("--wire") || "#fff");
    const components = (c: Color) => {
      const { r, g, b } = c.clone().convertLinearToSRGB();
      return [r, g, b] as [number, number, number];
    };
    this.renderer?.setClearColor(ground, 1);
    this.surface.setColours(components(ground), components(wire));
    this.requestDraw();
  }

  private requestDraw(): void {
    if (this.requested || !this.renderer) return;
    this.requested = requestAnimationFrame(() => {
      this.requested = 0;
      this.draw();
    });
  }

  private draw(): void {
    const [width, height] = [this.element.clientWidth, this.element.clientHeight];
    if (!this.renderer || width === 0 || height === 0) return;
    const ratio = Math.min(devicePixelRatio, MOST_PIXELS_PER_POINT);
    if (
      this.canvas.width !== Math.floor(width * ratio) ||
      this.canvas.height !== Math.floor(height * ratio) ||
      this.renderer.getPixelRatio() !== ratio
    ) {
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height);
    }
    this.surface.prepare();
    renderStereo(this.renderer, this.scene, this.camera, this.orbit, this.stereo, [width, height]);
    this.drawn += 1;
  }
}

function makeRenderer(canvas: HTMLCanvasElement): WebGLRenderer | null {
  try {
    const renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "default" });
    renderer.autoClear = false;
    return renderer;
  } catch {
    return null;
  }
}
