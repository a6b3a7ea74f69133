/** A refusal in words: what `application/problem+json` (RFC 9457) says, or what the network did instead. */
export class Problem extends Error {
  constructor(
    readonly title: string,
    readonly detail: string,
    /** HTTP status; 0 when no answer came. */
    readonly status: number,
  ) {
    super(detail ? `${title}: ${detail}` : title);
    this.name = "Problem";
  }

  /** Reads the body of a refused request. */
  static async from(response: Response): Promise<Problem> {
    const body: unknown = await response.json().catch(() => null);
    const text = (key: string) => {
      const value = body && typeof body === "object" ? (body as Record<string, unknown>)[key] : undefined;
      return typeof value === "string" ? value : "";
    };
    return new Problem(text("title") || `The daemon answered ${response.status}`, text("detail"), response.status);
  }

  /** No answer: the daemon is not there. */
  static unreachable(): Problem {
    return new Problem(
      "The daemon does not answer",
      "Check that gv3 serve runs on that machine (systemctl status gv3) and that the network is up.",
      0,
    );
  }
}

/** Words for anything that was thrown. */
export function inWords(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}
