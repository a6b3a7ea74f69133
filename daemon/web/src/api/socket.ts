/** What a socket is doing now. */
export type SocketState = "connecting" | "open" | "waiting" | "closed";

/** What {@link ReconnectingSocket} tells its owner. */
export interface SocketHandlers {
  /** A message: text, or bytes. */
  message: (data: string | ArrayBuffer) => void;
  /** A new state; called on every change. */
  state?: (state: SocketState) => void;
  /** The connection stands; say again what the other side must know. */
  open?: () => void;
  /** It could not be made or broke; `reason` is what the other side said, if anything. */
  lost?: (reason: string) => void;
}

const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 5000;

/** Wait before attempt `attempt` (0 first): doubled each time, a quarter of it by chance so that clients spread. */
export function backoffMs(attempt: number, random: number = Math.random()): number {
  const full = Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** attempt);
  return full * (0.75 + 0.25 * random);
}

/** A WebSocket that is made anew when it breaks, until closed. */
export class ReconnectingSocket {
  state: SocketState = "connecting";
  /** When the last message came, `performance.now()` clock; null before the first. */
  lastMessageMs: number | null = null;
  private socket: WebSocket | null = null;
  private attempt = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly url: string,
    private readonly handlers: SocketHandlers,
  ) {
    this.connect();
  }

  /** Sends a text message if the connection stands; what is lost must be said again at `open`. */
  send(text: string): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(text);
  }

  /** Ends it for good. */
  close(): void {
    this.set("closed");
    clearTimeout(this.timer);
    this.detach();
  }

  /** Tries at once, as after a login. */
  retryNow(): void {
    if (this.state !== "waiting") return;
    clearTimeout(this.timer);
    this.connect();
  }

  private connect(): void {
    this.set("connecting");
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.attempt = 0;
      this.set("open");
      this.handlers.open?.();
    };
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      this.lastMessageMs = performance.now();
      this.handlers.message(data);
    };
    socket.onclose = ({ reason }) => this.wait(reason);
    this.socket = socket;
  }

  private wait(reason: string): void {
    if (this.state === "closed") return;
    this.detach();
    this.set("waiting");
    this.timer = setTimeout(() => this.connect(), backoffMs(this.attempt++));
    this.handlers.lost?.(reason);
  }

  private detach(): void {
    const socket = this.socket;
    this.socket = null;
    if (!socket) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
  }

  private set(state: SocketState): void {
    if (state === this.state) return;
    this.state = state;
    this.handlers.state?.(state);
  }
}
