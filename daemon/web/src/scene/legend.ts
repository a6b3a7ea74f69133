import { h, setText } from "../ui/dom";
import { tickValues } from "../plot/ticks";

/** A bar of the colour map with numbers; the bar's colours are in the style sheet. */
export class Legend {
  private readonly title = h("span", { class: "legend-title" });
  private readonly numbers = h("div", { class: "legend-numbers" });
  private readonly body = h("div", { class: "legend-body" }, h("div", { class: "legend-bar" }), this.numbers);
  readonly element = h("div", { class: "legend", hidden: true }, this.title, this.body);
  private shown = "";

  hide(): void {
    this.element.hidden = true;
    this.shown = "";
  }

  /** Words instead of a scale. */
  note(text: string): void {
    if (this.shown === text) return;
    this.shown = text;
    this.element.hidden = false;
    setText(this.title, text);
    this.body.hidden = true;
  }

  show(title: string, low: number, high: number): void {
    const key = `${title} ${low} ${high}`;
    if (key === this.shown) return;
    this.shown = key;
    this.element.hidden = this.body.hidden = false;
    setText(this.title, title);
    const { values, format } = tickValues(low, high, 5);
    this.numbers.replaceChildren(
      ...values.map((v) => h("span", { style: `bottom: ${((v - low) / (high - low || 1)) * 100}%` }, format(v))),
    );
  }
}
