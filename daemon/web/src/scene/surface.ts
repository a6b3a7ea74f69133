import {
  BufferAttribute,
  BufferGeometry,
  DynamicDrawUsage,
  Group,
  LinearFilter,
  LineSegments,
  Mesh,
  Texture,
  type TypedArray,
} from "three";
import type { MeshMessage, Scalars } from "../api/mesh_message";
import type { ColourRange } from "./colour_range";
import type { Box } from "./orbit";
import { scalarsOf, SurfaceMaterial, type Look } from "./surface_material";

/** Room beyond what is needed when a buffer must grow, so that a live mesh does not grow one at every scan. */
const SPARE = 1.25;

/** Two ends of every side of every triangle; sides that two triangles share come twice, which costs less than finding them. */
export function wireIndices(triangles: Uint32Array): Uint32Array {
  const wires = new Uint32Array(triangles.length * 2);
  for (let t = 0, w = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [triangles[t]!, triangles[t + 1]!, triangles[t + 2]!];
    wires[w++] = a;
    wires[w++] = b;
    wires[w++] = b;
    wires[w++] = c;
    wires[w++] = c;
    wires[w++] = a;
  }
  return wires;
}

/** A surface on the graphics card, updated in place from mesh messages. */
export class Surface {
  readonly object = new Group();
  private readonly geometry = new BufferGeometry();
  private readonly wireGeometry = new BufferGeometry();
  private readonly material = new SurfaceMaterial();
  private readonly wireMaterial = new SurfaceMaterial(true);
  private readonly mesh = new Mesh(this.geometry, this.material);
  private readonly wires = new LineSegments(this.wireGeometry, this.wireMaterial);
  private texture: Texture | null = null;
  private triangles: Uint32Array | null = null;
  private wiresAreOld = true;
  private look: Look = "shaded";
  private scalars: { kind: Scalars; low: number; high: number } = { kind: "none", low: 0, high: 0 };
  /** Topology that the buffers hold. */
  topologyId: number | null = null;
  hasTexture = false;

  constructor(private readonly colours: ColourRange) {
    this.mesh.frustumCulled = this.wires.frustumCulled = false;
    this.wires.visible = false;
    this.object.add(this.mesh, this.wires);
  }

  /** Shows a message; false when it relies on triangles that never came. */
  update(message: MeshMessage, picture: ImageBitmap | null): boolean {
    if (!message.full && message.topologyId !== this.topologyId) return false;
    this.fill("position", message.positions, 3, false);
    if (message.uv) this.fill("uv", message.uv, 2, true);
    if (message.scalars) this.fill("scalar", message.scalars, 1, true);
    this.scalars = { kind: message.scalarKind, low: message.scalarLow, high: message.scalarHigh };
    if (message.triangles) {
      this.fillIndex(this.geometry, message.triangles);
      this.triangles = message.triangles;
      this.topologyId = message.topologyId;
      this.wiresAreOld = true;
    }
    for (const material of [this.material, this.wireMaterial]) material.setGrid(message.originMm, message.stepMm);
    if (this.isColoured) this.colours.extend(message.scalarLow, message.scalarHigh);
    if (picture) this.showPicture(picture);
    this.updateWires();
    return true;
  }

  setLook(look: Look): void {
    this.look = look;
    this.wires.visible = look === "wireframe";
    this.updateWires();
  }

  setGrey(grey: boolean): void {
    this.material.setGrey(grey);
    this.wireMaterial.setGrey(grey);
  }

  setColours(ground: [number, number, number], wire: [number, number, number]): void {
    this.material.setPlainColour(...ground);
    this.wireMaterial.setPlainColour(...wire);
  }

  /** Whether there are the numbers that the look colours by. */
  get isColoured(): boolean {
    return this.scalars.kind !== "none" && this.scalars.kind === scalarsOf(this.look);
  }

  /** Before every drawing. A surface without the numbers for its look is shaded. */
  prepare(): void {
    const isWithout = scalarsOf(this.look) !== "none" && !this.isColoured;
    this.material.setLook(isWithout ? "shaded" : this.look);
    const [least, most] = this.colours.span ?? [0, 1];
    const width = Math.max(most - least, 1e-6);
    this.material.setScalarPlaces((this.scalars.low - least) / width, (this.scalars.high - this.scalars.low) / width);
  }

  dispose(): void {
    this.geometry.dispose();
    this.wireGeometry.dispose();
    this.material.dispose();
    this.wireMaterial.dispose();
    this.texture?.dispose();
  }

  private fill(name: string, values: TypedArray, size: number, normalized: boolean): void {
    let attribute = this.geometry.getAttribute(name) as BufferAttribute | undefined;
    if (!attribute || attribute.array.length < values.length) {
      attribute = newAttribute(values, size, normalized);
      this.replaceAttribute(name, attribute);
    }
    upload(attribute, values);
  }

  private replaceAttribute(name: string, attribute: BufferAttribute): void {
    // Disposing frees every buffer of the geometry on the card; those kept are sent again at the next drawing.
    this.geometry.dispose();
    this.wireGeometry.dispose();
    this.geometry.setAttribute(name, attribute);
    this.wireGeometry.setAttribute(name, attribute);
  }

  private fillIndex(geometry: BufferGeometry, indices: Uint32Array): void {
    let index = geometry.getIndex();
    if (!index || index.array.length < indices.length) {
      geometry.dispose();
      index = newAttribute(indices, 1, false);
      geometry.setIndex(index);
    }
    upload(index, indices);
    geometry.setDrawRange(0, indices.length);
  }

  private updateWires(): void {
    if (this.look !== "wireframe" || !this.wiresAreOld || !this.triangles) return;
    this.fillIndex(this.wireGeometry, wireIndices(this.triangles));
    this.wiresAreOld = false;
  }

  private showPicture(picture: ImageBitmap): void {
    const old = this.texture?.image as ImageBitmap | undefined;
    if (!this.texture || old?.width !== picture.width || old.height !== picture.height) {
      this.texture?.dispose();
      this.texture = new Texture();
      this.texture.flipY = false;
      this.texture.generateMipmaps = false;
      this.texture.minFilter = this.texture.magFilter = LinearFilter;
      this.material.setPicture(this.texture);
      this.hasTexture = true;
    }
    this.texture.image = picture;
    this.texture.needsUpdate = true;
    old?.close();
  }
}

/** The box of a message: scans have x right, y up, z towards the scanner, as the display has. */
export function messageBox({ originMm: o, stepMm: s }: MeshMessage): Box {
  const far = o.map((x, k) => x + 65535 * s[k]!) as [number, number, number];
  return { low: [...o], high: far };
}

function newAttribute(values: TypedArray, size: number, normalized: boolean): BufferAttribute {
  const room = Math.ceil((values.length / size) * SPARE) * size;
  const array = new (values.constructor as new (length: number) => TypedArray)(room);
  const attribute = new BufferAttribute(array, size, normalized);
  attribute.setUsage(DynamicDrawUsage);
  return attribute;
}

function upload(attribute: BufferAttribute, values: TypedArray): void {
  (attribute.array as Uint16Array).set(values as Uint16Array);
  attribute.clearUpdateRanges();
  attribute.addUpdateRange(0, values.length);
  attribute.needsUpdate = true;
}
