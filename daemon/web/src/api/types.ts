/** What the daemon's HTTP interface sends and takes; field names are its own. */

export type ScannerState = "idle" | "starting" | "previewing" | "recording" | "stopping" | "failed";

/** The recording in progress. */
export interface Recording {
  session: string;
  segment: number;
  seconds: number;
  scans: number;
  keyframes: number;
  bytes: number;
  ratio: number;
  raw: boolean;
}

/** Twice a second over the event socket, and the body of `GET /status`. */
export interface Status {
  state: ScannerState;
  error: string | null;
  source: "simulated" | "recorded" | "hardware";
  rig: string;
  recording: Recording | null;
  scans_per_second: number;
  pictures_per_second: number;
  latency_ms: { p50: number | null; p99: number | null };
  degradation: "none" | "no_between_correction" | "no_between_scans";
  drops: Record<string, number>;
  queues: Record<string, number>;
  exposure: { saturated_share: number; dark_share: number; hint: "ok" | "too_bright" | "too_dark" } | null;
  disk: { free_bytes: number; total_bytes: number; floor_bytes: number; seconds_left: number | null };
  uptime_seconds: number;
  version: string;
}

/** A drop, fault, gap, mark or change of state as it happens, and as a session keeps it. */
export interface SessionEvent {
  tick?: number;
  time_nanos?: number;
  kind: string;
  [field: string]: unknown;
}

export interface PluggedProjector {
  backend: string;
  serial: string;
  bus_path: string;
  node?: string;
  speed?: string;
  problem?: string;
}

/** What `gv3 devices --json` prints. */
export interface Devices {
  cameras: { node: string; name: string; driver: string; bus: string; serial: string; formats: string[] }[];
  projectors: PluggedProjector[];
  serial_ports: { port: string; product: string; serial: string; usb_id: string; problem?: string }[];
  problems: string[];
}

/** One check of the doctor. */
export interface Check {
  name: string;
  outcome: "pass" | "fail" | "skip";
  detail: string;
  action: string | null;
}

export interface SessionSummary {
  name: string;
  bytes: number;
  seconds: number;
  scans: number;
  keyframes: number;
  ratio: number | null;
  created: string | null;
  state: "recording" | "complete" | "unfinished" | "damaged";
  mode: string;
  segments: number;
  tolerance_mm?: number | null;
  /** Bytes of the raw pictures kept beside it. */
  raw_bytes?: number;
  /** Why it is damaged. */
  fault?: string;
}

export interface SessionDetail extends SessionSummary {
  first_tick: number;
  last_tick: number;
  period_nanos: number;
  events: SessionEvent[];
  drops: Record<string, number>;
  missing_ticks: number;
  groups: { key_tick: number; bytes: number; scans: number }[];
}

/** Bytes of every scan of a session. */
export interface SessionCurve {
  ticks: number[];
  bytes: number[];
  is_key: boolean[];
}

export interface Job {
  id: string | number;
  kind: "verify" | "recover" | "export" | "compare";
  session: string;
  state: "running" | "done" | "failed" | "cancelled";
  done: number;
  total: number;
  error?: string | null;
  report?: unknown;
  result_bytes?: number | null;
}

export interface ExportRequest {
  as: "scan" | "mesh";
  format: string;
  first_tick?: number;
  last_tick?: number;
  fps?: number;
}

/** Distances between two sessions, scan by scan. */
export interface CompareReport {
  ticks: number[];
  rms_mm: (number | null)[];
  p95_mm: (number | null)[];
  rms_mm_all: number;
  p95_mm_all: number;
}

export interface RecordingStopped {
  session: string;
  files: string[];
  scans: number;
  keyframes: number;
  bytes: number;
  verified: boolean;
  ms: number;
}

export interface ReportName {
  name: string;
  kind: "sweep" | "measure";
}

export interface Errors {
  rms: number;
  p95: number;
  p99: number;
  max: number;
}

/** The parts of `gv3 sweep`'s report that are drawn. */
export interface SweepReport {
  input: string;
  scans: number;
  obj_bmp_bytes_per_scan: number;
  curves: {
    coder: string;
    about: string;
    unavailable: string | null;
    points: {
      setting: string;
      bytes_per_scan: number;
      rms_mm: number;
      max_mm: number;
      encode_ms_per_scan: number;
      decode_ms_per_scan: number;
      distortion: {
        surface_mm: { scan_to_replay: { all: Errors }; replay_to_scan: { all: Errors } };
        d1_psnr_db: number | null;
        d2_psnr_db: number | null;
      };
    }[];
  }[];
  bd_rates: { test: string; anchor: string; percent: number }[];
}

/** The parts of `gv3 measure --json` that are drawn. */
export interface MeasureReport {
  scans: number;
  keyframes: number;
  surface_mm: { scan_to_replay: { all: Errors }; replay_to_scan: { all: Errors } };
  bytes: { session: number };
  percent_of_raw: { obj_bmp: number; binary: number };
  curve: {
    tick: number;
    time_s: number;
    is_key: boolean;
    scan_to_replay_rms_mm: number;
    replay_to_scan_rms_mm: number;
    scan_to_replay_p95_mm: number;
    replay_to_scan_p95_mm: number;
    max_mm: number;
    texture_psnr_db: number | null;
  }[];
}
