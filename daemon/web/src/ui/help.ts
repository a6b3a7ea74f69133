import { button, h } from "./dom";
import { openDialog } from "./dialog";
import type { Keys, Shortcut } from "./keys";

const SHOWN: Record<string, string> = { " ": "Space", ArrowLeft: "←", ArrowRight: "→" };

/** The overlay that lists every key. */
export function showHelp(keys: Keys): void {
  const list = (shortcuts: Shortcut[]) =>
    h(
      "dl",
      { class: "keys" },
      ...shortcuts.flatMap(({ key, does }) => [
        h("dt", {}, h("kbd", {}, SHOWN[key] ?? key.toUpperCase())),
        h("dd", {}, does),
      ]),
    );
  const { view, everywhere } = keys.all();
  const off = h("input", { type: "checkbox", checked: !keys.off });
  off.addEventListener("change", () => (keys.off = !off.checked));
  const dialog = openDialog(
    "Keys",
    ...(view.length ? [h("h3", {}, "This view"), list(view)] : []),
    h("h3", {}, "Everywhere"),
    list(everywhere),
    h("h3", {}, "Surface in focus"),
    h(
      "dl",
      { class: "keys" },
      ...[
        ["← → ↑ ↓", "Turn (drag)"],
        ["Shift + arrows", "Move (right or middle drag, two fingers)"],
        ["+ −", "Nearer, farther (wheel, pinch)"],
        ["0", "Show all of it"],
      ].flatMap(([key, does]) => [h("dt", {}, h("kbd", {}, key)), h("dd", {}, does)]),
    ),
    h("label", { class: "check" }, off, " Single keys work (? always does)"),
    h(
      "div",
      { class: "dialog-buttons" },
      button("Close", () => dialog.close(), { autofocus: true }),
    ),
  );
  dialog.classList.add("wide");
}
