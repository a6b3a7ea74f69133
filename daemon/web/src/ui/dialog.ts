import { button, h } from "./dom";

/** A modal dialog with a heading; removes itself when closed. */
export function openDialog(heading: string, ...content: (Node | string)[]): HTMLDialogElement {
  const id = `dialog-${Math.random().toString(36).slice(2)}`;
  const dialog = h("dialog", { "aria-labelledby": id }, h("h2", { id }, heading), ...content);
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

/** Asks for a yes; the dangerous button is not the one that Enter presses. */
export function confirm(heading: string, text: string, yes: string): Promise<boolean> {
  return new Promise((resolve) => {
    let sure = false;
    const dialog = openDialog(
      heading,
      h("p", {}, text),
      h(
        "div",
        { class: "dialog-buttons" },
        button("Cancel", () => dialog.close(), { autofocus: true }),
        button(yes, () => ((sure = true), dialog.close()), { class: "danger" }),
      ),
    );
    dialog.addEventListener("close", () => resolve(sure));
  });
}

/** A form in a dialog: resolves with its fields, or null when it was left. */
export function ask(
  heading: string,
  fields: Node[],
  submit: string,
  check?: (data: FormData) => string | null,
): Promise<FormData | null> {
  return new Promise((resolve) => {
    let result: FormData | null = null;
    const complaint = h("p", { class: "complaint", role: "alert" });
    const form = h(
      "form",
      {
        method: "dialog",
        onsubmit: (event: Event) => {
          const data = new FormData(form);
          const wrong = check?.(data) ?? null;
          complaint.textContent = wrong;
          if (wrong) event.preventDefault();
          else result = data;
        },
      },
      ...fields,
      complaint,
      h(
        "div",
        { class: "dialog-buttons" },
        button("Cancel", () => dialog.close()),
        h("button", { type: "submit", class: "primary" }, submit),
      ),
    );
    const dialog = openDialog(heading, form);
    dialog.addEventListener("close", () => resolve(result));
  });
}

/** A labelled text field for {@link ask}. */
export function textField(label: string, name: string, value = "", props: Record<string, string | boolean> = {}): Node {
  return h("label", { class: "field" }, h("span", {}, label), h("input", { name, value, type: "text", ...props }));
}
