import type { Client } from "../api/client";
import type { DecodedMesh } from "../scene/mesh_stream";
import { ReplayChannel, type ReplayOutput, type Scalars } from "./channel";
import type { Playback } from "./playback";

/** Pictures a second asked of the daemon. */
const FPS = 30;

/** So near to an end is there: sensor times differ a little from whole periods. */
const END_S = 0.02;
/** A seek without an answer for so long is not waited for. */
const SEEK_PATIENCE_MS = 1000;

/** What the player shows its owner. */
export interface PlayerHandlers {
  mesh: (mesh: DecodedMesh) => void;
  changed: () => void;
  fault: (error: unknown) => void;
}

/** Plays one session: the daemon keeps the time, this says what is wanted and remembers it over broken connections. */
export class Player implements Playback {
  timeSeconds: number;
  /** Times real time, 0.1 to 4. */
  speed = 1;
  reverse = false;
  playing = false;
  loop = true;
  private scalars: Scalars = "none";
  /** When a seek was sent whose picture has not come; null when none is owed. */
  private soughtMs: number | null = null;
  private seekAgain = false;
  private readonly channel: ReplayChannel;

  constructor(
    client: Client,
    session: string,
    output: ReplayOutput,
    private readonly lengthSeconds: number,
    startSeconds: number,
    private readonly handlers: PlayerHandlers,
  ) {
    this.timeSeconds = startSeconds;
    this.channel = new ReplayChannel(client, session, output, {
      mesh: (mesh) => this.show(mesh),
      state: () => handlers.changed(),
      open: () => this.tellAll(),
      fault: handlers.fault,
    });
  }

  get socket() {
    return this.channel.socket;
  }

  play(): void {
    const atEnd = this.reverse ? this.timeSeconds <= 0 : this.timeSeconds >= this.lengthSeconds - END_S;
    if (atEnd && !this.loop) this.seek(this.reverse ? this.lengthSeconds : 0);
    this.playing = true;
    this.tellPlay();
  }

  pause(): void {
    this.playing = false;
    this.tellPlay();
  }

  setSpeed(speed: number): void {
    this.speed = speed;
    this.tellPlay();
  }

  setReverse(reverse: boolean): void {
    this.reverse = reverse;
    this.tellPlay();
  }

  setLoop(loop: boolean): void {
    this.loop = loop;
    this.channel.send({ loop });
    this.handlers.changed();
  }

  setScalars(scalars: Scalars): void {
    this.scalars = scalars;
    this.channel.send({ scalars });
    // What stands still is sent again with its colours.
    if (!this.playing) this.channel.send({ seek_seconds: this.timeSeconds });
  }

  seek(seconds: number): void {
    this.timeSeconds = Math.max(0, Math.min(this.lengthSeconds, seconds));
    this.handlers.changed();
    const now = performance.now();
    // While one seek is owed, later ones replace each other here instead of queueing there.
    this.seekAgain = this.soughtMs !== null && now - this.soughtMs < SEEK_PATIENCE_MS;
    if (this.seekAgain) return;
    this.soughtMs = now;
    this.channel.send({ seek_seconds: this.timeSeconds });
  }

  close(): void {
    this.channel.close();
  }

  private show(mesh: DecodedMesh): void {
    this.handlers.mesh(mesh);
    this.soughtMs = null;
    if (this.seekAgain) return this.seek(this.timeSeconds);
    this.timeSeconds = mesh.message.timeSeconds;
    const ended = this.reverse ? this.timeSeconds <= END_S : this.timeSeconds >= this.lengthSeconds - END_S;
    if (this.playing && !this.loop && ended) this.pause();
    this.handlers.changed();
  }

  private tellPlay(): void {
    this.channel.send({ play: this.playing ? (this.reverse ? -this.speed : this.speed) : 0 });
    this.handlers.changed();
  }

  private tellAll(): void {
    this.channel.send({ fps: FPS });
    this.channel.send({ loop: this.loop });
    this.channel.send({ scalars: this.scalars });
    this.channel.send({ seek_seconds: this.timeSeconds });
    this.tellPlay();
  }
}
