export type Theme = "dark" | "light";
const KEY = "gv3-theme";

/** What is shown now: the person's choice, else the system's. */
export function currentTheme(): Theme {
  const chosen = localStorage.getItem(KEY);
  if (chosen === "dark" || chosen === "light") return chosen;
  return matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
}

/** Shows a theme and keeps the choice. */
export function chooseTheme(theme: Theme): void {
  localStorage.setItem(KEY, theme);
  applyTheme();
}

/** Puts the theme on the page and tells those who draw by themselves. */
export function applyTheme(): void {
  document.documentElement.dataset["theme"] = currentTheme();
  dispatchEvent(new Event("gv3-theme"));
}

/** A colour of the style sheet. */
export function themeColour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
