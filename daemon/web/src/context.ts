import type { Client } from "./api/client";
import type { StatusFeed } from "./status_feed";
import type { Announcer } from "./ui/announce";
import type { Keys } from "./ui/keys";
import type { JobList } from "./job_list";
import type { Route } from "./ui/route";

/** What every view is given. */
export interface Context {
  client: Client;
  feed: StatusFeed;
  announcer: Announcer;
  keys: Keys;
  jobs: JobList;
}

/** A view while it is shown. */
export interface View {
  element: HTMLElement;
  dispose: () => void;
}

export type ViewFactory = (context: Context, route: Route) => View;
