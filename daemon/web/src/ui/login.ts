import type { Client } from "../api/client";
import { inWords, Problem } from "../api/problem";
import { openDialog } from "./dialog";
import { h } from "./dom";

/** Asks for the token until one is right. Asking again while the dialog is open does nothing. */
export function showLogin(client: Client, done: () => void): void {
  if (document.querySelector("dialog.login")) return;
  const token = h("input", {
    type: "password",
    name: "token",
    autocomplete: "current-password",
    required: true,
    autofocus: true,
  });
  const complaint = h("p", { class: "complaint", role: "alert" });
  const form = h(
    "form",
    {
      onsubmit: (event: Event) => {
        event.preventDefault();
        void submit();
      },
    },
    h(
      "p",
      {},
      "This scanner is reached over a network, so it asks for its token. It is in the file that gv3 serve named when it started.",
    ),
    h("label", { class: "field" }, h("span", {}, "Token"), token),
    complaint,
    h("div", { class: "dialog-buttons" }, h("button", { type: "submit", class: "primary" }, "Log in")),
  );
  const dialog = openDialog("Log in", form);
  dialog.classList.add("login");
  dialog.addEventListener("cancel", (event) => event.preventDefault());

  async function submit(): Promise<void> {
    try {
      await client.login(token.value.trim());
      dialog.close();
      done();
    } catch (error) {
      const wrong = error instanceof Problem && (error.status === 401 || error.status === 403);
      complaint.textContent = wrong ? "That token is not right. Copy it again, whole." : inWords(error);
      token.select();
    }
  }
}
