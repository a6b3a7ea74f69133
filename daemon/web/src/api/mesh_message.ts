/** Bytes before the positions. */
export const MESH_HEADER_BYTES = 72;
const MAGIC = 0x4d335647;

/** A message that is not what the interface describes. */
export class MessageError extends Error {}

/** What the scalars of a message are, in the order of their numbers. */
export const SCALARS = ["none", "depth", "error", "motion"] as const;
export type Scalars = (typeof SCALARS)[number];

/** A mesh as it came over the socket; arrays are views into the message, nothing is copied. */
export interface MeshMessage {
  /** Whether triangles and uv came too; otherwise those of `topologyId` still hold. */
  full: boolean;
  sequence: number;
  topologyId: number;
  timeSeconds: number;
  vertices: number;
  triangleCount: number;
  /** Position in mm = origin + step * value. */
  originMm: [number, number, number];
  stepMm: [number, number, number];
  scalarKind: Scalars;
  scalarLow: number;
  scalarHigh: number;
  /** Three a vertex. */
  positions: Uint16Array;
  /** Two a vertex, 0 to 65535 for 0 to 1, v upwards. */
  uv: Uint16Array | null;
  /** One a vertex, 0 to 255 from `scalarLow` to `scalarHigh`. */
  scalars: Uint8Array | null;
  /** Three corners a triangle; null unless `full`. */
  triangles: Uint32Array | null;
  /** A JPEG. */
  texture: Uint8Array<ArrayBuffer> | null;
}

const padded = (bytes: number) => Math.ceil(bytes / 4) * 4;

/** Reads a mesh message (little-endian, as typed arrays are on every machine with WebGL). */
export function readMesh(buffer: ArrayBuffer): MeshMessage {
  if (buffer.byteLength < MESH_HEADER_BYTES) throw new MessageError(`mesh message of ${buffer.byteLength} bytes`);
  const view = new DataView(buffer);
  const u32 = (at: number) => view.getUint32(at, true);
  const f32 = (at: number) => view.getFloat32(at, true);
  if (u32(0) !== MAGIC) throw new MessageError("not a mesh message");
  if (view.getUint8(4) !== 1) throw new MessageError(`mesh message version ${view.getUint8(4)}, this page reads 1`);
  const flags = view.getUint8(6);
  const [vertices, triangleCount, textureBytes] = [u32(24), u32(28), u32(56)];
  let at = MESH_HEADER_BYTES;
  const take = (bytes: number) => {
    const start = at;
    at += bytes;
    if (at > buffer.byteLength) throw new MessageError(`mesh message ends before byte ${at}`);
    return start;
  };
  const positions = new Uint16Array(buffer, take(padded(vertices * 6)), vertices * 3);
  const uv = flags & 2 ? new Uint16Array(buffer, take(vertices * 4), vertices * 2) : null;
  const scalars = flags & 4 ? new Uint8Array(buffer, take(padded(vertices)), vertices) : null;
  const full = view.getUint8(5) === 0;
  const triangles = full ? new Uint32Array(buffer, take(triangleCount * 12), triangleCount * 3) : null;
  const texture = flags & 1 && textureBytes > 0 ? new Uint8Array(buffer, take(textureBytes), textureBytes) : null;
  return {
    full,
    sequence: u32(8),
    topologyId: u32(12),
    timeSeconds: view.getFloat64(16, true),
    vertices,
    triangleCount,
    originMm: [f32(32), f32(36), f32(40)],
    stepMm: [f32(44), f32(48), f32(52)],
    scalarKind: (scalars && SCALARS[view.getUint8(7)]) ?? "none",
    scalarLow: f32(60),
    scalarHigh: f32(64),
    positions,
    uv,
    scalars,
    triangles,
    texture,
  };
}
