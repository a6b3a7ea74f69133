import { Problem } from "./problem";
import type {
  Check,
  Devices,
  ExportRequest,
  Job,
  RecordingStopped,
  ReportName,
  SessionCurve,
  SessionDetail,
  SessionSummary,
  Status,
} from "./types";

/** Where the interface is, next to wherever the page came from. */
export const API = "api/v1";

/** Longest wait for an answer; stop and doctor do real work. */
const TIMEOUT_MS = 30_000;

const session = (name: string) => `sessions/${encodeURIComponent(name)}`;

/** Typed calls of the daemon's HTTP interface. Every failure is a {@link Problem}. */
export class Client {
  /** Called when the daemon asks for a token. */
  onUnauthorized: () => void = () => undefined;

  constructor(readonly base: string = new URL(API, document.baseURI).href) {}

  /** Address of a path, for links, pictures and sockets. */
  url(path: string): string {
    return `${this.base}/${path}`;
  }

  /** The same for a WebSocket. */
  socketUrl(path: string): string {
    return this.url(path).replace(/^http/, "ws");
  }

  private async request<T>(method: string, path: string, body?: unknown): Promise<T> {
    const init: RequestInit = { method, signal: AbortSignal.timeout(TIMEOUT_MS), credentials: "same-origin" };
    if (body !== undefined) {
      init.headers = { "Content-Type": "application/json" };
      init.body = JSON.stringify(body);
    }
    const response = await fetch(this.url(path), init).catch((error: unknown) => {
      if (error instanceof DOMException && error.name === "TimeoutError") {
        throw new Problem("The daemon took too long", `No answer to ${method} ${path} in ${TIMEOUT_MS / 1000} s.`, 0);
      }
      throw Problem.unreachable();
    });
    if (response.status === 401 && path !== "login") this.onUnauthorized();
    if (!response.ok) throw await Problem.from(response);
    const text = await response.text();
    return (text ? JSON.parse(text) : undefined) as T;
  }

  login = (token: string) => this.request<void>("POST", "login", { token });
  status = () => this.request<Status>("GET", "status");
  startScanner = () => this.request<unknown>("POST", "scanner/start");
  stopScanner = () => this.request<unknown>("POST", "scanner/stop");
  startRecording = (request: { name?: string; raw?: boolean }) =>
    this.request<{ session: string }>("POST", "recording/start", request);
  stopRecording = () => this.request<RecordingStopped>("POST", "recording/stop");
  mark = (text: string) => this.request<{ tick: number }>("POST", "recording/mark", { text });
  reloadConfig = () => this.request<unknown>("POST", "config/reload");
  devices = () => this.request<Devices>("GET", "devices");
  doctor = () => this.request<{ checks: Check[] }>("POST", "doctor");

  sessions = () => this.request<{ sessions: SessionSummary[] }>("GET", "sessions").then((r) => r.sessions);
  session = (name: string) => this.request<SessionDetail>("GET", session(name));
  curve = (name: string) => this.request<SessionCurve>("GET", `${session(name)}/curve`);
  rename = (name: string, to: string) => this.request<unknown>("PATCH", session(name), { name: to });
  remove = (name: string) => this.request<unknown>("DELETE", session(name));
  verify = (name: string) => this.request<Job>("POST", `${session(name)}/verify`);
  recover = (name: string) => this.request<Job>("POST", `${session(name)}/recover`);
  export = (name: string, request: ExportRequest) => this.request<Job>("POST", `${session(name)}/export`, request);
  compare = (name: string, other: string) => this.request<Job>("POST", `${session(name)}/compare`, { with: other });

  jobs = () => this.request<{ jobs: Job[] }>("GET", "jobs").then((r) => r.jobs);
  job = (id: Job["id"]) => this.request<Job>("GET", `jobs/${id}`);
  result = (id: Job["id"]) => this.request<unknown>("GET", `jobs/${id}/result`);
  cancel = (id: Job["id"]) => this.request<unknown>("DELETE", `jobs/${id}`);
  reports = () => this.request<{ reports: ReportName[] }>("GET", "reports").then((r) => r.reports);
  report = (name: string) => this.request<unknown>("GET", `reports/${encodeURIComponent(name)}`);

  fileUrl = (name: string, segment = 1) => this.url(`${session(name)}/file${segment > 1 ? `?segment=${segment}` : ""}`);
  thumbnailUrl = (name: string) => this.url(`${session(name)}/thumbnail.png`);
  resultUrl = (id: Job["id"]) => this.url(`jobs/${id}/result`);
}
