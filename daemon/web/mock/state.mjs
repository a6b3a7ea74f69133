/** What the made-up daemon knows: its scanner, sessions and jobs. */

const PERIOD_NANOS = 33_333_333;
const FLOOR_BYTES = 5e9;

/** A session of so many scans. */
function session(name, scans, created, extra = {}) {
  const keyframes = Math.ceil(scans / 10);
  return {
    name,
    bytes: scans * 1500,
    seconds: Math.max(0, (scans - 1) * PERIOD_NANOS * 1e-9),
    scans,
    keyframes,
    ratio: 9120,
    created,
    state: "complete",
    mode: "default",
    segments: 1,
    tolerance_mm: 0.1,
    ...extra,
  };
}

export class MockState {
  scanner = "idle";
  error = null;
  recording = null;
  free = 412e9;
  unplugged = false;
  listeners = new Set();
  jobs = new Map();
  drops = { picture_lost: 0, picture_doubled: 0, queue_reconstruct: 0, queue_encode: 0 };
  began = Date.now();
  sessions = new Map(
    [
      session("smile", 180, "2026-03-02T09:14:00Z"),
      session("speech-long", 5400, "2026-03-01T16:40:00Z", { segments: 3, ratio: 8870 }),
      session("smile-coarse", 180, "2026-03-02T09:20:00Z", { tolerance_mm: 0.2, ratio: 13400, bytes: 160_000 }),
      session("power-cut", 61, "2026-02-27T11:02:00Z", { state: "unfinished" }),
      session("bad-disk", 240, "2026-02-20T08:30:00Z", { state: "damaged", ratio: null }),
    ].map((s) => [s.name, s]),
  );

  tell(event) {
    for (const listener of this.listeners) listener(event);
  }

  status() {
    const on = this.scanner === "previewing" || this.scanner === "recording";
    const seconds = this.recording ? (Date.now() - this.recording.begun) / 1000 : 0;
    const scans = Math.floor(seconds * 30);
    return {
      state: this.scanner,
      error: this.error,
      source: "simulated",
      rig: "mock",
      recording: this.recording && {
        session: this.recording.name,
        segment: 1,
        seconds,
        scans,
        keyframes: Math.ceil(scans / 10),
        bytes: scans * 1500,
        ratio: 9100,
        raw: this.recording.raw,
      },
      scans_per_second: on ? 29.6 + 0.8 * Math.random() : 0,
      pictures_per_second: on ? 180 : 0,
      latency_ms: on ? { p50: 88 + 6 * Math.random(), p99: 205 } : { p50: null, p99: null },
      degradation: "none",
      drops: this.drops,
      queues: { sets: 0, scans: on ? 1 : 0, groups: 0 },
      exposure: on ? { saturated_share: 0.002, dark_share: 0.31, hint: "ok" } : null,
      disk: {
        free_bytes: this.free,
        total_bytes: 1e12,
        floor_bytes: FLOOR_BYTES,
        seconds_left: this.recording ? Math.max(0, (this.free - FLOOR_BYTES) / 45_000) : null,
      },
      uptime_seconds: (Date.now() - this.began) / 1000,
      version: "0.1.0",
    };
  }

  detail(name) {
    const s = this.sessions.get(name);
    const groups = Array.from({ length: s.keyframes }, (_, k) => ({
      key_tick: Math.min(s.scans - 1, k * 10),
      bytes: 15_000,
      scans: 10,
    }));
    return {
      ...s,
      first_tick: 0,
      last_tick: s.scans - 1,
      period_nanos: PERIOD_NANOS,
      events: [
        { tick: 40, time_nanos: 40 * PERIOD_NANOS, kind: "mark", text: "laughs" },
        { tick: 90, time_nanos: 90 * PERIOD_NANOS, kind: "gap", ticks: 2 },
      ],
      drops: { picture_lost: 1 },
      missing_ticks: 2,
      groups,
    };
  }

  startRecording(name, raw) {
    if (this.unplugged) throw problem(503, "The camera is not there", "Plug it in again and see Devices.");
    if (this.free <= FLOOR_BYTES) {
      const floor = `Less than ${FLOOR_BYTES / 1e9} GB are free`;
      throw problem(507, "The disk is full", `${floor}. Delete sessions or move them away, then record again.`);
    }
    if (this.recording) throw problem(409, "A recording is running", "Stop it first.");
    const session = name || `scan-${new Date().toISOString().slice(0, 19).replaceAll(":", "-")}`;
    if (this.sessions.has(session)) throw problem(409, "That name is taken", `There is a session ${session} already.`);
    this.recording = { name: session, raw, begun: Date.now() };
    this.scanner = "recording";
    return session;
  }

  stopRecording() {
    if (!this.recording) throw problem(409, "Nothing is being recorded", "");
    const { name, begun } = this.recording;
    const scans = Math.max(1, Math.floor(((Date.now() - begun) / 1000) * 30));
    const made = session(name, scans, new Date().toISOString());
    this.sessions.set(name, made);
    this.recording = null;
    this.scanner = this.unplugged ? "failed" : "previewing";
    const { keyframes, bytes } = made;
    return { session: name, files: [`${name}.gv3`], scans, keyframes, bytes, verified: true, ms: 120 };
  }

  unplug(out) {
    this.unplugged = out;
    if (out) {
      this.tell({ kind: "fault", source: "capture", message: "the camera is disconnected", tick: 123 });
      if (!this.recording) this.scanner = "failed";
    } else {
      this.tell({ kind: "gap", tick: 123, ticks: 30 });
      if (!this.recording) this.scanner = "previewing";
    }
  }

  fillDisk(full) {
    this.free = full ? 4e9 : 412e9;
    if (full && this.recording) {
      this.stopRecording();
      this.error =
        "The recording was stopped: the disk is down to its floor of 5 GB. Delete sessions or move them away.";
      this.tell({ kind: "fault", source: "disk", message: "at its floor" });
    }
    if (!full) this.error = null;
  }

  startJob(kind, session, finish) {
    const id = String(this.jobs.size + 1);
    const job = { id, kind, session, state: "running", done: 0, total: 20 };
    this.jobs.set(id, job);
    const timer = setInterval(() => {
      if (job.state !== "running") return clearInterval(timer);
      job.done += 2;
      if (job.done < job.total) return;
      clearInterval(timer);
      Object.assign(job, { state: "done" }, finish());
    }, 100);
    return job;
  }
}

/** A refusal, as the interface words it. */
export function problem(status, title, detail) {
  return Object.assign(new Error(title), { status, title, detail });
}
