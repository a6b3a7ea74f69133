import type { Check, Devices } from "../api/types";
import type { Context } from "../context";
import { button, h } from "../ui/dom";

const OUTCOME_WORDS: Record<Check["outcome"], string> = { pass: "good", fail: "fails", skip: "not checked" };

/** What is plugged in, and what the doctor says about it. */
export class DevicePanel {
  private readonly list = h("ul", { class: "devices" });
  private readonly checks = h("ul", { class: "checks", "aria-live": "polite" });
  private readonly examine = button("Examine", () => void this.runDoctor(), {
    title: "Check rights, trigger, linearity, calibration and disk",
  });
  readonly element: HTMLElement;

  constructor(private readonly context: Context) {
    this.element = h(
      "section",
      { class: "panel device-panel", "aria-label": "Devices" },
      h(
        "header",
        {},
        h("h2", {}, "Devices"),
        h("span", { class: "spring" }),
        button("Look again", () => void this.look()),
        this.examine,
      ),
      this.list,
      this.checks,
    );
    void this.look();
  }

  private async look(): Promise<void> {
    const devices = await this.context.announcer.attempt(() => this.context.client.devices());
    if (devices) this.list.replaceChildren(...lines(devices));
  }

  private async runDoctor(): Promise<void> {
    this.examine.disabled = true;
    this.examine.textContent = "Examining…";
    const result = await this.context.announcer.attempt(() => this.context.client.doctor());
    this.examine.disabled = false;
    this.examine.textContent = "Examine";
    if (result) this.checks.replaceChildren(...result.checks.map(checkLine));
  }
}

function lines({ cameras, projectors, serial_ports: ports, problems }: Devices): HTMLElement[] {
  const line = (kind: string, text: string, problem?: string | null) =>
    h("li", {}, h("b", {}, kind), ` ${text}`, problem && h("p", { class: "action" }, problem));
  const found = [
    ...cameras.map((c) => line("Camera", `${c.name} at ${c.node}, ${c.formats.join(" ")}`)),
    ...projectors.map((p) => line("Projector", `${p.backend} ${p.serial} at ${p.bus_path}`, p.problem)),
    ...ports.map((p) => line("Serial port", `${p.product} at ${p.port}`, p.problem)),
    ...problems.map((problem) => h("li", {}, h("p", { class: "action" }, problem))),
  ];
  return found.length ? found : [h("li", {}, "Nothing is plugged in. The simulated scanner needs nothing.")];
}

function checkLine({ name, outcome, detail, action }: Check): HTMLElement {
  return h(
    "li",
    { "data-outcome": outcome },
    h("b", {}, name),
    ` ${OUTCOME_WORDS[outcome]}: ${detail}`,
    outcome === "fail" && action && h("p", { class: "action" }, action),
  );
}
