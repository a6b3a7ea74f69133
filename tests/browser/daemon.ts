import { spawn, type ChildProcess } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { createServer } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

/** A daemon under test. */
export interface Daemon {
  url: string;
  /** Ends it and starts it again at the same address, on the same sessions. */
  restart: () => Promise<void>;
  stop: () => Promise<void>;
}

/** A port that was free a moment ago. */
function freePort(): Promise<number> {
  return new Promise((resolve) => {
    const probe = createServer();
    probe.listen(0, "127.0.0.1", () => {
      const { port } = probe.address() as { port: number };
      probe.close(() => resolve(port));
    });
  });
}

async function until(what: string, ready: () => Promise<boolean>): Promise<void> {
  for (let k = 0; k < 300; k += 1) {
    if (await ready().catch(() => false)) return;
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  throw new Error(`${what} did not happen within 30 s`);
}

/** `gv3 serve` on a folder of its own. */
export class RealDaemon implements Daemon {
  url = "";
  private child: ChildProcess | null = null;

  /** `more` are further arguments; `folder` is where sessions are. */
  constructor(
    private readonly more: string[] = ["--sim"],
    readonly folder = mkdtempSync(join(tmpdir(), "gv3-browser-")),
  ) {}

  async start(): Promise<this> {
    const listen = this.url ? new URL(this.url).host : `127.0.0.1:${await freePort()}`;
    const args = ["serve", ...this.more, "--sessions", this.folder, "--listen", listen];
    this.child = spawn(process.env["GV3_BIN"] ?? "gv3", args, { stdio: ["ignore", "inherit", "inherit"] });
    this.url = `http://${listen}/`;
    await until(`gv3 ${args.join(" ")}`, async () => (await fetch(`${this.url}healthz`)).ok);
    return this;
  }

  async end(): Promise<void> {
    const child = this.child;
    this.child = null;
    if (!child || child.exitCode !== null) return;
    const ended = new Promise((resolve) => child.once("exit", resolve));
    child.kill("SIGTERM");
    await ended;
  }

  async restart(): Promise<void> {
    await this.end();
    await this.start();
  }

  async stop(): Promise<void> {
    await this.end();
    rmSync(this.folder, { recursive: true, force: true });
  }
}

/** The mock daemon, and its switches. */
export class MockDaemon implements Daemon {
  url = "";
  private mock: { url: string; port: number; close: () => Promise<void> } | null = null;

  constructor(private readonly token: string | null = null) {}

  async start(): Promise<this> {
    const module = pathToFileURL(join(__dirname, "../../daemon/web/mock/server.mjs")).href;
    // A plain `import` would be turned into `require`, which cannot load it.
    const load = new Function("path", "return import(path)") as (path: string) => Promise<{
      startMock: (options: object) => Promise<NonNullable<MockDaemon["mock"]>>;
    }>;
    const { startMock } = await load(module);
    this.mock = await startMock({ port: this.url ? Number(new URL(this.url).port) : 0, token: this.token });
    this.url = this.mock.url;
    return this;
  }

  /** Pulls or plugs the camera, fills or empties the disk. */
  async set(switches: { unplug?: boolean; full?: boolean }): Promise<void> {
    await fetch(`${this.url}mock`, { method: "POST", body: JSON.stringify(switches) });
  }

  async end(): Promise<void> {
    await this.mock?.close();
    this.mock = null;
  }

  async restart(): Promise<void> {
    await this.end();
    await this.start();
  }

  stop = () => this.end();
}
