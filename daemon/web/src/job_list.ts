import type { Client } from "./api/client";
import { inWords } from "./api/problem";
import type { Job } from "./api/types";

const POLL_MS = 400;

/** Work of the daemon that this page began: followed until it ends. */
export class JobList {
  readonly jobs = new Map<Job["id"], Job>();
  private readonly listeners = new Set<() => void>();

  constructor(private readonly client: Client) {}

  onChange(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  /** Follows a job; resolves with it when it has ended, whichever way. */
  async follow(started: Job): Promise<Job> {
    let job = started;
    this.take(job);
    while (job.state === "running") {
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      job = await this.client.job(job.id).catch((error: unknown) => ({
        ...job,
        // A daemon that restarted knows nothing of it.
        state: "failed" as const,
        error: inWords(error),
      }));
      this.take(job);
    }
    return job;
  }

  /** Takes a job off the list; one that runs is cancelled first. */
  async dismiss(job: Job): Promise<void> {
    if (job.state === "running") await this.client.cancel(job.id);
    else {
      this.jobs.delete(job.id);
      this.tell();
    }
  }

  private take(job: Job): void {
    this.jobs.set(job.id, job);
    this.tell();
  }

  private tell(): void {
    for (const listener of this.listeners) listener();
  }
}
