import type { ReconnectingSocket } from "../api/socket";
import type { Scalars } from "../api/mesh_message";

/** What the controls of a replay work on: one session, or two in step. */
export interface Playback {
  readonly timeSeconds: number;
  readonly speed: number;
  readonly reverse: boolean;
  readonly playing: boolean;
  readonly loop: boolean;
  readonly socket: ReconnectingSocket;
  play: () => void;
  pause: () => void;
  seek: (seconds: number) => void;
  setSpeed: (speed: number) => void;
  setReverse: (reverse: boolean) => void;
  setLoop: (loop: boolean) => void;
  setScalars: (scalars: Scalars) => void;
  close: () => void;
}
