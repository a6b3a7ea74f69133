/** Where the person is: `#/replay/smile?with=smile2`. */
export interface Route {
  view: string;
  /** Name of a session or report; empty when none. */
  name: string;
  query: URLSearchParams;
}

/** Reads a location hash. */
export function readRoute(hash: string): Route {
  const [path = "", query = ""] = hash.replace(/^#\/?/, "").split("?", 2);
  const [view = "", ...rest] = path.split("/");
  let name = rest.join("/");
  try {
    name = decodeURIComponent(name);
  } catch {
    // A bad escape is part of the name then.
  }
  return { view: view || "operate", name, query: new URLSearchParams(query) };
}

/** Writes one. */
export function routeHash(view: string, name = "", query: Record<string, string> = {}): string {
  const text = new URLSearchParams(query).toString();
  return `#/${view}${name ? `/${encodeURIComponent(name)}` : ""}${text ? `?${text}` : ""}`;
}
