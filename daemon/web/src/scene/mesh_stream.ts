import { readMesh, type MeshMessage } from "../api/mesh_message";

/** A mesh with its picture unpacked, ready to be shown. */
export interface DecodedMesh {
  message: MeshMessage;
  picture: ImageBitmap | null;
}

/** Unpacks messages in the order in which they came; pictures unpack beside the page's thread. */
export class MeshStream {
  private last: Promise<void> = Promise.resolve();

  /** `show` is given each mesh in turn; `fault` what could not be read. */
  constructor(
    private readonly show: (mesh: DecodedMesh) => void,
    private readonly fault: (error: unknown) => void,
  ) {}

  receive(data: string | ArrayBuffer): void {
    if (typeof data === "string") return;
    const decoded = decode(data);
    this.last = this.last.then(() => decoded.then(this.show, this.fault));
  }
}

async function decode(data: ArrayBuffer): Promise<DecodedMesh> {
  const message = readMesh(data);
  // What is transparent or wide-gamut elsewhere is plain bytes here: no conversion of any kind.
  const options: ImageBitmapOptions = { colorSpaceConversion: "none", premultiplyAlpha: "none" };
  const picture = message.texture ? await createImageBitmap(new Blob([message.texture]), options) : null;
  return { message, picture };
}
