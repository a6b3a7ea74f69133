type Child = Node | string | null | undefined | false;
type Props = Record<string, string | number | boolean | EventListener | null | undefined>;

/** Makes an element. `on…` properties are listeners, booleans are attributes that are there or not, text is text. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  props: Props = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  setProps(element, props);
  for (const child of children) if (child) element.append(child);
  return element;
}

/** The same for SVG. */
export function svg<K extends keyof SVGElementTagNameMap>(
  tag: K,
  props: Props = {},
  ...children: Child[]
): SVGElementTagNameMap[K] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  setProps(element, props);
  for (const child of children) if (child) element.append(child);
  return element;
}

function setProps(element: Element, props: Props): void {
  for (const [name, value] of Object.entries(props)) {
    if (typeof value === "function") element.addEventListener(name.slice(2).toLowerCase(), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, String(value));
  }
}

/** Replaces text only where it changed, so that readers and selections are not disturbed. */
export function setText(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

/** A button with a listener. */
export function button(label: string, onclick: () => void, props: Props = {}): HTMLButtonElement {
  return h("button", { type: "button", onclick: () => onclick(), ...props }, label);
}

/** A set of labelled choices, exactly one of them taken. */
export function choices<T extends string>(
  legend: string,
  options: readonly (readonly [T, string])[],
  taken: T,
  onchange: (value: T) => void,
): { element: HTMLElement; select: (value: T) => void } {
  const buttons = new Map(
    options.map(([value, label]) => [value, button(label, () => (select(value), onchange(value)))]),
  );
  const select = (value: T) => {
    for (const [key, b] of buttons) b.setAttribute("aria-pressed", String(key === value));
  };
  select(taken);
  return { element: h("div", { role: "group", "aria-label": legend, class: "choices" }, ...buttons.values()), select };
}

/** A labelled drop-down. */
export function dropdown<T extends string>(
  label: string,
  options: readonly (readonly [T, string])[],
  taken: T,
  onchange: (value: T) => void,
): { element: HTMLElement; select: HTMLSelectElement } {
  const select = h(
    "select",
    {},
    ...options.map(([value, text]) => h("option", { value, selected: value === taken }, text)),
  );
  select.addEventListener("change", () => onchange(select.value as T));
  return { element: h("label", { class: "field" }, h("span", {}, label), select), select };
}
