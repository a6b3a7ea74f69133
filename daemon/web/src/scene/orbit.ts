/** A box in millimetres: x right, y up, z towards the viewer. */
export interface Box {
  low: [number, number, number];
  high: [number, number, number];
}

/** Field of view along the shorter side of the picture, degrees. */
export const FIELD_OF_VIEW_DEG = 30;
/** Room around what is fitted. */
const MARGIN = 1.1;
const STEEPEST_RAD = Math.PI / 2 - 0.01;

/** Where the viewer stands: on a sphere about a target. Several viewers may share one, and then move together. */
export class Orbit {
  /** Point looked at, mm. */
  target: [number, number, number] = [0, 0, 0];
  azimuthRad = 0;
  elevationRad = 0;
  distanceMm = 1000;
  private box: Box | null = null;
  private readonly listeners = new Set<() => void>();

  /** Whether something was ever shown. */
  get fitted(): boolean {
    return this.box !== null;
  }

  onChange(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  /** Shows all of a box from the front. */
  fit(box: Box): void {
    this.box = box;
    this.reset();
  }

  /** Back to where {@link fit} began. */
  reset(): void {
    if (!this.box) return;
    const { low, high } = this.box;
    this.target = [0, 1, 2].map((k) => (low[k]! + high[k]!) / 2) as Orbit["target"];
    const [width, height, depth] = [0, 1, 2].map((k) => high[k]! - low[k]!) as [number, number, number];
    const half = (Math.max(width, height) / 2) * MARGIN;
    this.distanceMm = Math.max(1, half / Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360) + depth / 2);
    this.azimuthRad = this.elevationRad = 0;
    this.tell();
  }

  turn(azimuthRad: number, elevationRad: number): void {
    this.azimuthRad += azimuthRad;
    this.elevationRad = Math.max(-STEEPEST_RAD, Math.min(STEEPEST_RAD, this.elevationRad + elevationRad));
    this.tell();
  }

  /** Moves the target along the picture, in shorter sides of the picture. */
  pan(right: number, up: number): void {
    const side = 2 * this.distanceMm * Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
    const { right: r, up: u } = this.axes();
    for (const k of [0, 1, 2] as const) this.target[k] += side * (right * r[k]! + up * u[k]!);
    this.tell();
  }

  /** Factors below 1 go nearer. */
  zoom(factor: number): void {
    this.distanceMm = Math.max(10, Math.min(20_000, this.distanceMm * factor));
    this.tell();
  }

  /** Right, up and backward (to the eye) of the picture, unit vectors. */
  axes(): { right: number[]; up: number[]; back: number[] } {
    const [sa, ca] = [Math.sin(this.azimuthRad), Math.cos(this.azimuthRad)];
    const [se, ce] = [Math.sin(this.elevationRad), Math.cos(this.elevationRad)];
    return { right: [ca, 0, -sa], up: [-sa * se, ce, -ca * se], back: [sa * ce, se, ca * ce] };
  }

  private tell(): void {
    for (const listener of this.listeners) listener();
  }
}
