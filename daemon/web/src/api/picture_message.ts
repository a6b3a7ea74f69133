import { MessageError } from "./mesh_message";

/** Views of the camera that the daemon sends. */
export const PICTURE_VIEWS = ["camera", "fringe", "modulation", "phase", "mask"] as const;
export type PictureView = (typeof PICTURE_VIEWS)[number];

const HEADER_BYTES = 24;
const MAGIC = 0x50335647;

/** A camera picture; `image` is a JPEG or PNG file. */
export interface PictureMessage {
  sequence: number;
  timeSeconds: number;
  image: Blob;
}

/** Reads a picture message. */
export function readPicture(buffer: ArrayBuffer): PictureMessage {
  const view = new DataView(buffer);
  if (buffer.byteLength <= HEADER_BYTES || view.getUint32(0, true) !== MAGIC) {
    throw new MessageError("not a picture message");
  }
  const bytes = new Uint8Array(buffer, HEADER_BYTES);
  const type = bytes[0] === 0x89 ? "image/png" : "image/jpeg";
  return {
    sequence: view.getUint32(8, true),
    timeSeconds: view.getFloat64(16, true),
    image: new Blob([bytes], { type }),
  };
}
