import type { Client } from "../api/client";
import type { Scalars } from "../api/mesh_message";
import type { DecodedMesh } from "../scene/mesh_stream";
import { ReplayChannel, SAME_S, type ReplayOutput } from "./channel";
import type { Playback } from "./playback";

/** Pictures a second asked of the daemon. */
const FPS = 30;

/** What the player shows its owner. */
export interface PlayerHandlers {
  mesh: (mesh: DecodedMesh, isLate: boolean) => void;
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
      mesh: (mesh, isLate) => this.show(mesh, isLate),
      state: () => handlers.changed(),
      open: () => this.tellAll(),
      fault: handlers.fault,
    });
  }

  get socket() {
    return this.channel.socket;
  }

  play(): void {
    const atEnd = this.reverse ? this.timeSeconds <= 0 : this.timeSeconds >= this.lengthSeconds - SAME_S;
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
    if (!this.playing) this.channel.seek(this.timeSeconds);
  }

  seek(seconds: number): void {
    this.timeSeconds = Math.max(0, Math.min(this.lengthSeconds, seconds));
    this.handlers.changed();
    // While one seek is owed, later ones replace each other here instead of queueing there.
    this.seekAgain = this.channel.isSeeking;
    if (!this.seekAgain) this.channel.seek(this.timeSeconds);
  }

  close(): void {
    this.channel.close();
  }

  private show(mesh: DecodedMesh, isLate: boolean): void {
    this.handlers.mesh(mesh, isLate);
    if (isLate) return;
    if (this.seekAgain) return this.seek(this.timeSeconds);
    this.timeSeconds = mesh.message.timeSeconds;
    const ended = this.reverse ? this.timeSeconds <= SAME_S : this.timeSeconds >= this.lengthSeconds - SAME_S;
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
    this.channel.seek(this.timeSeconds);
    this.tellPlay();
  }
}
