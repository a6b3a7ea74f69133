/**
 * The values that the colours of a look span. It grows with what is shown and is shared by surfaces side by side, so that
 * a colour means the same from moment to moment and on both.
 */
export class ColourRange {
  private ends: [number, number] | null = null;
  private readonly listeners = new Set<() => void>();

  /** Lowest and highest value; null before the first. */
  get span(): [number, number] | null {
    return this.ends;
  }

  onChange(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  extend(low: number, high: number): void {
    const [least, most] = this.ends ?? [Infinity, -Infinity];
    if (low >= least && high <= most) return;
    this.ends = [Math.min(least, low), Math.max(most, high)];
    for (const listener of this.listeners) listener();
  }

  /** Forgets what was shown: the colours mean something else from now on. */
  reset(): void {
    this.ends = null;
  }
}
