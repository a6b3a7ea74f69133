import type { Status } from "../api/types";
import type { Context, View } from "../context";
import { button, h, setText } from "../ui/dom";
import { ask, textField } from "../ui/dialog";
import { bytes, clock, count, duration, ratio } from "../ui/format";
import { checkName } from "../ui/session_name";
import { CameraPanel } from "./camera_panel";
import { DevicePanel } from "./device_panel";
import { EventLog } from "./event_log";
import { Gauges } from "./gauges";
import { LiveMeshPanel } from "./live_mesh_panel";

const STATE_WORDS: Record<Status["state"], string> = {
  idle: "Scanner off",
  starting: "Scanner starting",
  previewing: "Previewing",
  recording: "Recording",
  stopping: "Stopping",
  failed: "Scanner failed",
};

const SOURCE_WORDS: Record<Status["source"], string> = {
  simulated: "simulated scanner",
  recorded: "recorded pictures",
  hardware: "scanner",
};

const DEGRADATION_WORDS: Record<Status["degradation"], string> = {
  none: "",
  no_between_correction: "Too slow: scans between keyframes are stored without their correction. Nothing is lost.",
  no_between_scans: "Much too slow: only keyframes are stored. Stop other programs on this machine.",
};

/** The scanner as it runs. */
export function operateView(context: Context): View {
  return new OperateView(context);
}

class OperateView implements View {
  private readonly state = h("strong", { class: "state" });
  private readonly about = h("span", { class: "about" });
  private readonly complaint = h("p", { class: "notice fault", role: "alert", hidden: true });
  private readonly warning = h("p", { class: "notice", hidden: true });
  private readonly power = button("Start scanner", () => this.togglePower());
  private readonly record = button("Record", () => this.toggleRecord(), { class: "record" });
  private readonly mark = button("Mark", () => void this.addMark());
  private readonly name = h("input", {
    type: "text",
    placeholder: "named by time",
    "aria-label": "Name of the next recording",
    spellcheck: "false",
    maxlength: "100",
  });
  private readonly raw = h("input", { type: "checkbox" });
  private readonly progress = h("p", { class: "recording-line" });
  private readonly camera: CameraPanel;
  private readonly mesh: LiveMeshPanel;
  private readonly gauges = new Gauges();
  private readonly devices: DevicePanel;
  private readonly log: EventLog;
  private readonly forget: (() => void)[];
  private busy = false;
  readonly element: HTMLElement;

  constructor(private readonly context: Context) {
    const isOff = () => ["idle", "failed"].includes(context.feed.status?.state ?? "idle");
    this.camera = new CameraPanel(context, isOff);
    this.mesh = new LiveMeshPanel(context, isOff);
    this.devices = new DevicePanel(context);
    this.log = new EventLog();
    this.element = h(
      "main",
      { class: "operate" },
      h("h1", { class: "visually-hidden" }, "Operate"),
      h("div", { class: "top" }, this.controls(), this.complaint, this.warning),
      this.camera.element,
      this.mesh.element,
      this.gauges.element,
      this.devices.element,
      this.log.element,
    );
    this.forget = [
      context.feed.onStatus((status) => this.show(status)),
      context.feed.onEvent((event) => this.log.add(event)),
    ];
    context.keys.setLocal([
      { key: "r", does: "Record or stop", run: () => this.toggleRecord() },
      { key: "m", does: "Mark this moment", run: () => void this.addMark() },
      { key: "p", does: "Scanner on or off", run: () => this.togglePower() },
      ...this.camera.shortcuts(),
    ]);
    if (!context.feed.status) this.enable(null);
  }

  dispose(): void {
    for (const forget of this.forget) forget();
    this.camera.dispose();
    this.mesh.dispose();
  }

  private controls(): HTMLElement {
    return h(
      "section",
      { class: "panel controls", "aria-label": "Scanner" },
      h("div", { class: "state-line" }, this.state, this.about),
      h(
        "div",
        { class: "buttons" },
        this.power,
        h("label", { class: "field inline" }, h("span", {}, "Name"), this.name),
        h(
          "label",
          { class: "check", title: "Keep every camera picture without loss beside the session" },
          this.raw,
          " raw pictures",
        ),
        this.record,
        this.mark,
      ),
      this.progress,
    );
  }

  private show(status: Status): void {
    setText(this.state, STATE_WORDS[status.state]);
    this.state.dataset["state"] = status.state;
    const about = new Set([SOURCE_WORDS[status.source], status.rig]);
    setText(this.about, [...about].join(" · "));
    this.complaint.hidden = status.error === null;
    setText(this.complaint, status.error ?? "");
    const warning = DEGRADATION_WORDS[status.degradation];
    this.warning.hidden = warning === "";
    setText(this.warning, warning);
    const r = status.recording;
    const segment = r && r.segment > 1 ? ` · segment ${r.segment}` : "";
    setText(
      this.progress,
      r
        ? `${r.session}${segment} · ${clock(r.seconds)} · ${count(r.scans)} scans · ${bytes(r.bytes)} · ${ratio(r.ratio)}${r.raw ? " · with raw pictures" : ""}`
        : "",
    );
    this.progress.hidden = r === null;
    this.gauges.show(status);
    this.enable(status);
  }

  private enable(status: Status | null): void {
    const state = status?.state;
    const between = state === "starting" || state === "stopping" || !state;
    const recording = state === "recording";
    setText(this.power, state === "previewing" || recording ? "Stop scanner" : "Start scanner");
    setText(this.record, recording ? "Stop" : "Record");
    this.record.classList.toggle("on", recording);
    this.power.disabled = this.busy || between || recording;
    this.record.disabled = this.busy || between;
    this.mark.disabled = this.busy || !recording;
    this.name.disabled = this.raw.disabled = recording;
  }

  /** Runs a command with the buttons locked, then asks what came of it. */
  private async command<T>(work: () => Promise<T>): Promise<T | null> {
    if (this.busy) return null;
    this.busy = true;
    this.enable(this.context.feed.status);
    const result = await this.context.announcer.attempt(work);
    this.busy = false;
    await this.context.feed.refresh().catch(() => undefined);
    this.enable(this.context.feed.status);
    return result;
  }

  private togglePower(): void {
    if (this.power.disabled) return;
    const { client, feed } = this.context;
    const on = feed.status?.state === "previewing";
    void this.command(() => (on ? client.stopScanner() : client.startScanner()));
  }

  private toggleRecord(): void {
    if (this.record.disabled) return;
    void (this.context.feed.status?.state === "recording" ? this.stop() : this.start());
  }

  private async start(): Promise<void> {
    const name = this.name.value.trim();
    const wrong = name && checkName(name);
    if (wrong) return this.context.announcer.fault(new Error(wrong));
    const request = { raw: this.raw.checked, ...(name && { name }) };
    const started = await this.command(() => this.context.client.startRecording(request));
    if (started) this.context.announcer.say(`Recording ${started.session}`);
  }

  private async stop(): Promise<void> {
    const stopped = await this.command(() => this.context.client.stopRecording());
    if (!stopped) return;
    const { session, scans, bytes: size, verified, ms } = stopped;
    const checked = verified ? "verified" : "NOT verified: run Verify in Sessions";
    const length = `${count(scans)} scans, ${bytes(size)}`;
    this.context.announcer.say(`${session}: ${length}, closed and ${checked} in ${duration(Math.ceil(ms / 1000))}`);
    this.name.value = "";
  }

  private async addMark(): Promise<void> {
    if (this.mark.disabled) return;
    const data = await ask(
      "Mark this moment",
      [textField("Text", "text", "", { maxlength: "200", required: true })],
      "Mark",
    );
    if (!data) return;
    const marked = await this.context.announcer.attempt(() => this.context.client.mark(String(data.get("text"))));
    if (marked) this.context.announcer.say(`Marked at tick ${marked.tick}`);
  }
}
