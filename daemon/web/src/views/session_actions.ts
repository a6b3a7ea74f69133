import type { ExportRequest, Job, SessionSummary } from "../api/types";
import type { Context } from "../context";
import { button, dropdown, h } from "../ui/dom";
import { ask, confirm, openDialog, textField } from "../ui/dialog";
import { follow } from "../ui/download";
import { bytes, clock } from "../ui/format";
import { routeHash } from "../ui/route";
import { checkName } from "../ui/session_name";

const FORMATS = [
  ["obj", "OBJ, BMP and MTL (MeshLab, Blender)"],
  ["ply", "PLY and PNG"],
  ["gltf", "glTF (.glb), a tracked mesh animated"],
] as const;

/** What can be done with a session: buttons, and the dialogs behind them. */
export class SessionActions {
  /** `reload` reads the list again after something changed. */
  constructor(
    private readonly context: Context,
    private readonly reload: () => void,
  ) {}

  buttons(session: SessionSummary): HTMLElement[] {
    if (session.state === "recording") return [h("span", { class: "sub" }, "stop it first")];
    const { name } = session;
    const whole = session.scans > 0;
    const act = (label: string, run: () => void, props = {}) =>
      button(label, run, { "aria-label": `${label} ${name}`, "data-focus": `${label} ${name}`, ...props });
    return [
      act("Replay", () => (location.hash = routeHash("replay", name)), { disabled: !whole }),
      act("Measure", () => (location.hash = routeHash("measure", name)), { disabled: !whole }),
      act("Export…", () => void this.export(session), { disabled: !whole }),
      act("More…", () => this.more(session)),
    ];
  }

  private more(session: SessionSummary): void {
    const { name } = session;
    const dialog = openDialog(name);
    const act = (label: string, help: string, run: () => void, props = {}) =>
      h(
        "li",
        {},
        button(label, () => (dialog.close(), run()), props),
        h("span", { class: "sub" }, help),
      );
    dialog.append(
      h(
        "ul",
        { class: "menu" },
        act("Download", `The session file, ${bytes(session.bytes)}.`, () => this.download(session)),
        act("Verify", "Every checksum, the index, and that every group decodes.", () => void this.verify(name)),
        act("Recover", "Make a clean session of every complete group.", () => void this.recover(name)),
        act("Rename…", "Segments and raw pictures go with it.", () => void this.rename(name)),
        act("Delete…", "For good; asks first.", () => void this.remove(session), { class: "danger" }),
      ),
      h(
        "div",
        { class: "dialog-buttons" },
        button("Close", () => dialog.close(), { autofocus: true }),
      ),
    );
  }

  private async export(session: SessionSummary): Promise<void> {
    const what = [
      ["scan", "Scans as captured, with holes and ragged borders"],
      ["mesh", "The tracked mesh, one connectivity a shot"],
    ] as const;
    const number = (label: string, name: string) =>
      textField(label, name, "", { inputmode: "decimal", placeholder: "all" });
    const [output, format] = [
      dropdown("Surface", what, "scan", () => undefined),
      dropdown("Files", FORMATS, "obj", () => undefined),
    ];
    output.select.name = "as";
    format.select.name = "format";
    const fps = textField("Frames a second", "fps", "", { inputmode: "decimal", placeholder: "as captured" });
    const fields = [
      output.element,
      format.element,
      number("From tick", "first_tick"),
      number("To tick", "last_tick"),
      fps,
    ];
    const data = await ask(`Export ${session.name}`, fields, "Export", (d) =>
      ["first_tick", "last_tick", "fps"].some((k) => !/^\d*(\.\d+)?$/.test(String(d.get(k)).trim()))
        ? "Ticks and frames a second are numbers; leave them empty for all."
        : null,
    );
    if (!data) return;
    const request: ExportRequest = {
      as: String(data.get("as")) as "scan" | "mesh",
      format: String(data.get("format")),
    };
    for (const key of ["first_tick", "last_tick", "fps"] as const) {
      const text = String(data.get(key)).trim();
      if (text) request[key] = Number(text);
    }
    await this.job(() => this.context.client.export(session.name, request));
  }

  /** Every segment is a file of its own. */
  private download({ name, segments }: SessionSummary): void {
    for (let segment = 1; segment <= segments; segment += 1) follow(this.context.client.fileUrl(name, segment));
  }

  private verify = (name: string) => this.job(() => this.context.client.verify(name));

  private async recover(name: string): Promise<void> {
    await this.job(() => this.context.client.recover(name));
    this.reload();
  }

  /** Starts a job and says how it ended; its panel shows it meanwhile. */
  private async job(start: () => Promise<Job>): Promise<void> {
    const { announcer, jobs } = this.context;
    const ended = await announcer.attempt(async () => jobs.follow(await start()));
    if (ended?.state === "done") announcer.say(`${ended.session}: ${ended.kind} done`);
    if (ended?.state === "failed") announcer.fault(new Error(`${ended.session}: ${ended.kind} failed: ${ended.error}`));
  }

  private async rename(name: string): Promise<void> {
    const field = textField("New name", "name", name, { autofocus: true, spellcheck: "false" });
    const data = await ask(`Rename ${name}`, [field], "Rename", (d) => checkName(String(d.get("name")).trim()));
    const to = String(data?.get("name") ?? name).trim();
    if (!data || to === name) return;
    const done = await this.context.announcer.attempt(async () => {
      await this.context.client.rename(name, to);
      return true;
    });
    if (done) this.context.announcer.say(`${name} is now ${to}`);
    this.reload();
  }

  private async remove({ name, seconds, bytes: size, segments }: SessionSummary): Promise<void> {
    const files = segments > 1 ? ` in ${segments} segments` : "";
    const text = `${clock(seconds)} of scans, ${bytes(size)}${files}. This cannot be undone.`;
    if (!(await confirm(`Delete ${name}?`, text, "Delete"))) return;
    const done = await this.context.announcer.attempt(async () => {
      await this.context.client.remove(name);
      return true;
    });
    if (done) this.context.announcer.say(`${name} deleted`);
    this.reload();
  }
}
