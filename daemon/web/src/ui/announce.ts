import { h } from "./dom";
import { inWords } from "../api/problem";

const SHOWN_MS = 6000;

/** Messages to the person: shown for some seconds, and told to assistive technology. Faults stay until closed. */
export class Announcer {
  private readonly polite = h("div", { role: "status", "aria-live": "polite", class: "toasts" });
  private readonly assertive = h("div", { role: "alert", "aria-live": "assertive", class: "toasts" });
  readonly element = h("div", { class: "toast-corner" }, this.assertive, this.polite);

  /** Something went as asked. */
  say(text: string): void {
    const toast = h("div", { class: "toast" }, text);
    this.polite.append(toast);
    setTimeout(() => toast.remove(), SHOWN_MS);
  }

  /** Something did not. */
  fault(error: unknown): void {
    const text = inWords(error);
    if ([...this.assertive.children].some((toast) => toast.firstChild?.textContent === text)) return;
    const toast = h("div", { class: "toast fault" }, h("span", {}, text));
    toast.append(h("button", { type: "button", "aria-label": "Close message", onclick: () => toast.remove() }, "×"));
    this.assertive.append(toast);
  }

  /** Runs what may fail and says so if it does; null then. */
  async attempt<T>(work: () => Promise<T>): Promise<T | null> {
    try {
      return await work();
    } catch (error) {
      this.fault(error);
      return null;
    }
  }
}
