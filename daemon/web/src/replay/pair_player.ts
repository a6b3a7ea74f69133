import type { Client } from "../api/client";
import type { Scalars } from "../api/mesh_message";
import type { DecodedMesh } from "../scene/mesh_stream";
import { ReplayChannel, type ReplayOutput } from "./channel";
import { advance, Barrier } from "./lock_step";
import type { Playback } from "./playback";

/** A side that does not answer for so long is asked again. */
const PATIENCE_MS = 2000;

/** One of two sessions. */
export interface Side {
  session: string;
  output: ReplayOutput;
  lengthSeconds: number;
}

/** Plays two sessions in lock-step: this keeps the time, and shows a moment only when both sides have it. */
export class PairPlayer implements Playback {
  timeSeconds: number;
  speed = 1;
  reverse = false;
  playing = false;
  loop = true;
  private readonly channels: ReplayChannel[];
  private readonly barrier: Barrier;
  private readonly arrived: (DecodedMesh | undefined)[] = [];
  readonly lengthSeconds: number;
  private scalars: Scalars = "none";
  private askedMs = 0;
  private again = false;
  private timer: ReturnType<typeof setTimeout> | undefined;

  constructor(
    client: Client,
    private readonly sides: Side[],
    startSeconds: number,
    private readonly handlers: {
      mesh: (side: number, mesh: DecodedMesh, isLate: boolean) => void;
      changed: () => void;
      fault: (error: unknown) => void;
    },
  ) {
    this.timeSeconds = startSeconds;
    this.lengthSeconds = Math.max(...sides.map((side) => side.lengthSeconds));
    this.barrier = new Barrier(sides.length);
    this.channels = sides.map(
      ({ session, output }, side) =>
        new ReplayChannel(client, session, output, {
          mesh: (mesh, isLate) => this.take(side, mesh, isLate),
          state: () => handlers.changed(),
          open: () => this.opened(side),
          fault: handlers.fault,
        }),
    );
  }

  /** The side that has been silent longest. */
  get socket() {
    const quiet = (channel: ReplayChannel) => channel.socket.lastMessageMs ?? 0;
    return this.channels.reduce((a, b) => (quiet(a) <= quiet(b) ? a : b)).socket;
  }

  play(): void {
    if (!this.loop && this.timeSeconds >= this.lengthSeconds && !this.reverse) this.timeSeconds = 0;
    this.playing = true;
    this.ask();
  }

  pause(): void {
    this.playing = false;
    this.handlers.changed();
  }

  seek(seconds: number): void {
    this.timeSeconds = Math.max(0, Math.min(this.lengthSeconds, seconds));
    this.ask();
  }

  setSpeed(speed: number): void {
    this.speed = speed;
    this.handlers.changed();
  }

  setReverse(reverse: boolean): void {
    this.reverse = reverse;
    this.handlers.changed();
  }

  setLoop(loop: boolean): void {
    this.loop = loop;
    this.handlers.changed();
  }

  setScalars(scalars: Scalars): void {
    this.scalars = scalars;
    for (const channel of this.channels) channel.send({ scalars });
    this.ask();
  }

  close(): void {
    clearTimeout(this.timer);
    for (const channel of this.channels) channel.close();
  }

  /** A side that (again) has a connection is told what a side is told, whatever is owed. */
  private opened(side: number): void {
    this.channels[side]?.send({ scalars: this.scalars });
    if (this.barrier.waiting) this.tell(side);
    else this.ask();
  }

  /** Asks both sides for the moment; when one is still owed, once it has come. */
  private ask(): void {
    this.handlers.changed();
    const now = performance.now();
    this.again = this.barrier.waiting && now - this.askedMs < PATIENCE_MS;
    if (this.again) return;
    this.askedMs = now;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.barrier.waiting && this.ask(), PATIENCE_MS + 1);
    this.barrier.ask();
    for (const side of this.sides.keys()) this.tell(side);
  }

  private tell(side: number): void {
    const seconds = Math.min(this.timeSeconds, this.sides[side]!.lengthSeconds);
    this.channels[side]?.seek(seconds);
  }

  private take(side: number, mesh: DecodedMesh, isLate: boolean): void {
    if (isLate) return this.handlers.mesh(side, mesh, true);
    const earlier = this.arrived[side];
    if (earlier) this.handlers.mesh(side, earlier, true);
    this.arrived[side] = mesh;
    if (!this.barrier.arrived(side)) return;
    for (const [k, arrived] of this.arrived.entries()) if (arrived) this.handlers.mesh(k, arrived, false);
    this.arrived.length = 0;
    this.handlers.changed();
    if (this.again) this.ask();
    else if (this.playing) requestAnimationFrame(() => this.step());
  }

  private step(): void {
    if (!this.playing || this.barrier.waiting) return;
    const elapsed = (performance.now() - this.askedMs) / 1000;
    const { time, ended } = advance(this.timeSeconds, elapsed, this);
    this.timeSeconds = time;
    if (ended) this.playing = false;
    this.ask();
  }
}
