/** Longest time that one step may take, so that a page in the background does not leap. */
const LONGEST_STEP_S = 0.1;

/** Where a clock that plays goes next. */
export interface Pace {
  speed: number;
  reverse: boolean;
  loop: boolean;
  lengthSeconds: number;
}

/** The time `elapsedSeconds` later; `ended` when a clock that does not loop has come to its end. */
export function advance(time: number, elapsedSeconds: number, pace: Pace): { time: number; ended: boolean } {
  const step = Math.min(elapsedSeconds, LONGEST_STEP_S) * pace.speed * (pace.reverse ? -1 : 1);
  const next = time + step;
  if (next >= 0 && next <= pace.lengthSeconds) return { time: next, ended: false };
  if (!pace.loop) return { time: Math.max(0, Math.min(pace.lengthSeconds, next)), ended: true };
  return { time: pace.reverse ? pace.lengthSeconds : 0, ended: false };
}

/** Waits until every side has shown the moment that was asked for. */
export class Barrier {
  private readonly missing = new Set<number>();

  constructor(private readonly sides: number) {}

  /** A moment was asked of all sides. */
  ask(): void {
    for (let side = 0; side < this.sides; side += 1) this.missing.add(side);
  }

  /** A side has it; true when it was the last. */
  arrived(side: number): boolean {
    return this.missing.delete(side) && this.missing.size === 0;
  }

  get waiting(): boolean {
    return this.missing.size > 0;
  }
}
