import type { Client } from "../api/client";
import { ReconnectingSocket, type SocketState } from "../api/socket";
import { MeshStream, type DecodedMesh } from "../scene/mesh_stream";

export type ReplayOutput = "scan" | "mesh";
export type Scalars = "none" | "depth" | "error" | "motion";

/** Vertices asked for: what a tablet draws at 30 scans a second. */
export const MOST_VERTICES = 20_000;

/** What a replay tells the player. */
export interface ChannelHandlers {
  mesh: (mesh: DecodedMesh) => void;
  state: (state: SocketState) => void;
  /** The connection is new: the player says where it was. */
  open: () => void;
  fault: (error: unknown) => void;
}

/** One session being decoded by the daemon for this page. */
export class ReplayChannel {
  readonly socket: ReconnectingSocket;
  private readonly stream: MeshStream;

  constructor(client: Client, session: string, output: ReplayOutput, handlers: ChannelHandlers) {
    this.stream = new MeshStream((mesh) => {
      handlers.mesh(mesh);
      this.send({ ack: mesh.message.sequence });
    }, handlers.fault);
    const path = `sessions/${encodeURIComponent(session)}/replay?as=${output}&max_vertices=${MOST_VERTICES}`;
    this.socket = new ReconnectingSocket(client.socketUrl(path), {
      message: (data) => {
        this.stream.receive(data);
      },
      state: (state) => handlers.state(state),
      open: () => handlers.open(),
      // Without words from the daemon, HTTP may have some: a session that is gone, a token that is needed.
      lost: (reason) => {
        if (reason) handlers.fault(new Error(`${session}: ${reason}`));
        else void client.session(session).catch(handlers.fault);
      },
    });
  }

  send(command: Record<string, unknown>): void {
    this.socket.send(JSON.stringify(command));
  }

  close(): void {
    this.socket.close();
  }
}
