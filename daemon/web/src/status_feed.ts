import type { Client } from "./api/client";
import { ReconnectingSocket } from "./api/socket";
import type { SessionEvent, Status } from "./api/types";

/** The daemon's state as it goes: one event socket for the whole page. */
export class StatusFeed {
  /** The newest state; null before the first. */
  status: Status | null = null;
  readonly socket: ReconnectingSocket;
  private readonly statusListeners = new Set<(status: Status) => void>();
  private readonly eventListeners = new Set<(event: SessionEvent) => void>();
  private readonly connectionListeners = new Set<() => void>();

  constructor(private readonly client: Client) {
    this.socket = new ReconnectingSocket(client.socketUrl("live/events"), {
      message: (data) => this.receive(data),
      state: () => this.connectionListeners.forEach((listener) => listener()),
      // A socket cannot say why it was refused; this asks for the token if that is why.
      lost: () => void client.status().catch(() => undefined),
    });
  }

  /** Calls at once with what is known, then at every change; returns how to stop. */
  onStatus(listener: (status: Status) => void): () => void {
    this.statusListeners.add(listener);
    if (this.status) listener(this.status);
    return () => this.statusListeners.delete(listener);
  }

  onEvent(listener: (event: SessionEvent) => void): () => void {
    this.eventListeners.add(listener);
    return () => this.eventListeners.delete(listener);
  }

  onConnection(listener: () => void): () => void {
    this.connectionListeners.add(listener);
    return () => this.connectionListeners.delete(listener);
  }

  /** Asks now, as after a command, instead of waiting for the next message. */
  async refresh(): Promise<void> {
    this.take(await this.client.status());
  }

  private receive(data: string | ArrayBuffer): void {
    if (typeof data !== "string") return;
    const message = JSON.parse(data) as { status?: Status; event?: SessionEvent };
    if (message.status) this.take(message.status);
    if (message.event) for (const listener of this.eventListeners) listener(message.event);
  }

  private take(status: Status): void {
    this.status = status;
    for (const listener of this.statusListeners) listener(status);
  }
}
