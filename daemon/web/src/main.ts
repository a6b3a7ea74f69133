import { Client } from "./api/client";
import type { Context, View, ViewFactory } from "./context";
import { JobList } from "./job_list";
import { Shell } from "./shell";
import { StatusFeed } from "./status_feed";
import { Announcer } from "./ui/announce";
import { Keys } from "./ui/keys";
import { showLogin } from "./ui/login";
import { readRoute } from "./ui/route";
import { applyTheme } from "./ui/theme";
import { measureView } from "./views/measure";
import { sessionsView } from "./views/sessions";

/** Views with surfaces bring three.js with them: loaded when they are first shown. */
const VIEWS: Record<string, () => Promise<ViewFactory>> = {
  operate: () => import("./views/operate").then((m) => m.operateView),
  sessions: () => Promise.resolve(sessionsView),
  replay: () => import("./views/replay").then((m) => m.replayView),
  measure: () => Promise.resolve(measureView),
};

function start(): void {
  applyTheme();
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", applyTheme);
  const client = new Client();
  const context: Context = {
    client,
    feed: new StatusFeed(client),
    announcer: new Announcer(),
    keys: new Keys(),
    jobs: new JobList(client),
  };
  const shell = new Shell(context);
  document.getElementById("app")?.append(shell.element);

  let view: View | null = null;
  let asked = 0;
  const show = async () => {
    const mine = ++asked;
    const route = readRoute(location.hash);
    const load = VIEWS[route.view] ?? VIEWS["operate"]!;
    const factory = await context.announcer.attempt(load);
    if (!factory || mine !== asked) return;
    view?.dispose();
    context.keys.setLocal([]);
    view = factory(context, route);
    shell.showView(VIEWS[route.view] ? route.view : "operate", view.element);
  };
  client.onUnauthorized = () => {
    showLogin(client, () => {
      context.feed.socket.retryNow();
      void show();
    });
  };
  addEventListener("hashchange", () => void show());
  void show();
}

start();
