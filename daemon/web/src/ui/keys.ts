/** One key that does something. */
export interface Shortcut {
  /** `KeyboardEvent.key`; letters in lower case. */
  key: string;
  /** What it does, for the help. */
  does: string;
  run: () => void;
}

const OFF_KEY = "gv3-shortcuts-off";

/** Single keys of the page and of the view shown. They can be turned off, for speech input and for accidents. */
export class Keys {
  private readonly global: Shortcut[] = [];
  private local: Shortcut[] = [];

  constructor() {
    addEventListener("keydown", (event) => this.press(event));
  }

  get off(): boolean {
    return localStorage.getItem(OFF_KEY) !== null;
  }

  set off(off: boolean) {
    if (off) localStorage.setItem(OFF_KEY, "1");
    else localStorage.removeItem(OFF_KEY);
  }

  /** Keys that hold everywhere. */
  addGlobal(...shortcuts: Shortcut[]): void {
    this.global.push(...shortcuts);
  }

  /** Keys of the view that is shown now. */
  setLocal(shortcuts: Shortcut[]): void {
    this.local = shortcuts;
  }

  /** All that hold now, for the help. */
  all(): { view: Shortcut[]; everywhere: Shortcut[] } {
    return { view: this.local, everywhere: this.global };
  }

  private press(event: KeyboardEvent): void {
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
    if (document.querySelector("dialog[open]") || ownsKeys(event)) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (this.off && key !== "?") return;
    const found = [...this.local, ...this.global].find((shortcut) => shortcut.key === key);
    if (!found) return;
    event.preventDefault();
    found.run();
  }
}

/** Whether what has the focus uses this key itself. */
function ownsKeys({ target, key }: KeyboardEvent): boolean {
  if (!(target instanceof HTMLElement)) return false;
  if (target.matches("input:not([type=range], [type=checkbox]), textarea, select")) return true;
  if (target.matches("button, a, summary, [type=checkbox]")) return key === " " || key === "Enter";
  return target.matches("[type=range]") && (key.startsWith("Arrow") || key === "Home" || key === "End");
}
