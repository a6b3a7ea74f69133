import type { Client } from "../api/client";
import { ReconnectingSocket, type SocketState } from "../api/socket";
import { MeshStream, type DecodedMesh } from "../scene/mesh_stream";

export type ReplayOutput = "scan" | "mesh";

/** Vertices asked for: what a tablet draws at 30 scans a second. */
export const MOST_VERTICES = 20_000;

/** So near to what was sought is there: sensor times differ a little from whole periods, at the ends above all. */
export const SAME_S = 0.02;
/** A seek without an answer for so long is not waited for. */
const PATIENCE_MS = 2000;

/** What a replay tells the player. */
export interface ChannelHandlers {
  /** `isLate`: of a place left by a seek since; later messages may rely on its triangles, but it is not to be seen. */
  mesh: (mesh: DecodedMesh, isLate: boolean) => void;
  state: (state: SocketState) => void;
  /** The connection is new: the player says where it was. */
  open: () => void;
  fault: (error: unknown) => void;
}

/** One session being decoded by the daemon for this page. */
export class ReplayChannel {
  readonly socket: ReconnectingSocket;
  private readonly stream: MeshStream;
  /** The seek whose message has not come. */
  private sought: { seconds: number; ms: number } | null = null;

  constructor(client: Client, session: string, output: ReplayOutput, handlers: ChannelHandlers) {
    this.stream = new MeshStream((mesh) => {
      handlers.mesh(mesh, this.isLate(mesh.message.timeSeconds));
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

  /** Shows a moment; what was on its way before is late from now on. */
  seek(seconds: number): void {
    this.sought = { seconds, ms: performance.now() };
    this.send({ seek_seconds: seconds });
  }

  /** Whether a seek waits for its message. */
  get isSeeking(): boolean {
    return this.sought !== null && performance.now() - this.sought.ms < PATIENCE_MS;
  }

  close(): void {
    this.socket.close();
  }

  private isLate(timeSeconds: number): boolean {
    if (this.isSeeking && Math.abs(timeSeconds - this.sought!.seconds) > SAME_S) return true;
    this.sought = null;
    return false;
  }
}
