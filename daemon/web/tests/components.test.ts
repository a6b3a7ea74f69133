import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { Client } from "../src/api/client";
import { Problem } from "../src/api/problem";
import { ReconnectingSocket } from "../src/api/socket";
import { MockState } from "../mock/state.mjs";
import { Plot } from "../src/plot/plot";
import { Announcer } from "../src/ui/announce";
import { Keys } from "../src/ui/keys";
import { StaleMark } from "../src/ui/stale";
import { choices } from "../src/ui/dom";
import { FakeSocket } from "./fake_socket";

afterEach(() => {
  vi.unstubAllGlobals();
  document.body.replaceChildren();
});

describe("the client", () => {
  const answer = (status: number, body: unknown) =>
    vi.stubGlobal(
      "fetch",
      vi.fn(() => Promise.resolve(new Response(body === null ? null : JSON.stringify(body), { status }))),
    );

  it("says what the daemon says, in words", async () => {
    answer(507, { title: "The disk is full", detail: "Delete sessions.", status: 507 });
    await expect(new Client("http://d/api/v1").startRecording({})).rejects.toThrow(
      "The disk is full: Delete sessions.",
    );
  });

  it("asks for the token on 401, but not while one is being tried", async () => {
    answer(401, { title: "A token is needed" });
    const client = new Client("http://d/api/v1");
    client.onUnauthorized = vi.fn();
    await expect(client.status()).rejects.toBeInstanceOf(Problem);
    expect(client.onUnauthorized).toHaveBeenCalledTimes(1);
    await expect(client.login("x")).rejects.toBeInstanceOf(Problem);
    expect(client.onUnauthorized).toHaveBeenCalledTimes(1);
  });

  it("says what to do when nothing answers", async () => {
    vi.stubGlobal("fetch", () => Promise.reject(new TypeError("refused")));
    await expect(new Client("http://d/api/v1").sessions()).rejects.toThrow("gv3 serve");
  });

  it("escapes names", () => {
    expect(new Client("http://d/api/v1").fileUrl("a/b?")).toBe("http://d/api/v1/sessions/a%2Fb%3F/file");
  });
});

it("the mock daemon refuses what the daemon refuses", () => {
  const state = new MockState();
  expect(state.startRecording("t1", false)).toBe("t1");
  expect(() => state.startRecording("t2", false)).toThrow("A recording is running");
  expect(state.stopRecording()).toMatchObject({ session: "t1", verified: true });
  expect(() => state.startRecording("t1", false)).toThrow("taken");
  state.fillDisk(true);
  expect(() => state.startRecording("t3", false)).toThrow("full");
});

describe("a socket", () => {
  beforeEach(() => {
    FakeSocket.all = [];
    vi.useFakeTimers();
    vi.stubGlobal("WebSocket", FakeSocket);
  });
  afterEach(() => {
    vi.useRealTimers();
  });

  it("comes back by itself, says so, and ends when closed", () => {
    const states: string[] = [];
    const open = vi.fn();
    const socket = new ReconnectingSocket("ws://d", { message: () => undefined, state: (s) => states.push(s), open });
    const first = FakeSocket.all[0]!;
    first.onopen!();
    first.onclose!({ reason: "" });
    expect(socket.state).toBe("waiting");
    vi.advanceTimersByTime(250);
    expect(FakeSocket.all.length).toBe(2);
    FakeSocket.all[1]!.onopen!();
    expect(open).toHaveBeenCalledTimes(2);
    socket.close();
    vi.advanceTimersByTime(60_000);
    expect(FakeSocket.all.length).toBe(2);
    expect(states).toEqual(["open", "waiting", "connecting", "open", "closed"]);
  });

  it("is marked stale with the seconds since the last message", () => {
    const socket = new ReconnectingSocket("ws://d", { message: () => undefined });
    FakeSocket.all[0]!.readyState = 1;
    FakeSocket.all[0]!.onopen!();
    FakeSocket.all[0]!.onmessage!({ data: "{}" });
    const mark = new StaleMark(() => socket);
    vi.advanceTimersByTime(1500);
    expect(mark.element.hidden).toBe(true);
    vi.advanceTimersByTime(4000);
    expect(mark.element.textContent).toBe("stale since 5 s");
    FakeSocket.all[0]!.onmessage!({ data: "{}" });
    vi.advanceTimersByTime(500);
    expect(mark.element.hidden).toBe(true);
    mark.dispose();
    socket.close();
  });
});

describe("a plot", () => {
  const data = {
    title: "Bytes",
    xLabel: "Time, s",
    yLabel: "Bytes",
    series: [
      { name: "one", x: [0, 1, 2], y: [1, null, 3], marks: [true, false, true] },
      { name: "two", x: [0, 1, 2], y: [2, 2, 2] },
    ],
  };
  beforeEach(() => {
    vi.stubGlobal(
      "ResizeObserver",
      class {
        observe() {}
        disconnect() {}
      },
    );
  });

  it("draws a curve a series with a gap where there is no value", () => {
    const plot = new Plot(data);
    const paths = [...plot.element.querySelectorAll(".plot-picture .curve")].map((p) => p.getAttribute("d")!);
    expect(paths.map((d) => d.match(/M/g)!.length)).toEqual([2, 1]);
    expect(plot.element.querySelectorAll(".plot-picture .mark").length).toBe(2);
    expect(plot.element.querySelector(".plot-stage")!.getAttribute("aria-label")).toContain("one from 1 to 3");
  });

  it("reads points out by key and hides a curve by its legend", () => {
    const plot = new Plot(data);
    document.body.append(plot.element);
    const stage = plot.element.querySelector(".plot-stage")!;
    stage.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", cancelable: true }));
    expect(plot.element.querySelector(".plot-readout")!.textContent).toContain("Time, s 0, Bytes 1, keyframe");
    plot.element.querySelector<HTMLButtonElement>(".legend-entry")!.click();
    expect(plot.element.querySelectorAll(".plot-picture .curve").length).toBe(1);
  });

  it("says so when there is nothing to draw", () => {
    const plot = new Plot({ ...data, series: [{ name: "none", x: [1], y: [null] }] });
    expect(plot.element.textContent).toContain("No values to draw");
  });
});

it("keys act, unless a field has the focus or they are turned off", () => {
  localStorage.clear();
  const keys = new Keys();
  const run = vi.fn();
  keys.setLocal([{ key: "r", does: "record", run }]);
  const field = document.createElement("input");
  document.body.append(field);
  const press = (target: EventTarget, init: KeyboardEventInit) =>
    target.dispatchEvent(new KeyboardEvent("keydown", { bubbles: true, cancelable: true, ...init }));
  press(document.body, { key: "R" });
  press(field, { key: "r" });
  press(document.body, { key: "r", ctrlKey: true });
  keys.off = true;
  press(document.body, { key: "r" });
  keys.off = false;
  expect(run).toHaveBeenCalledTimes(1);
});

it("faults stay until closed and are told once", () => {
  const announcer = new Announcer();
  announcer.fault(new Error("no camera"));
  announcer.fault(new Error("no camera"));
  expect(announcer.element.querySelectorAll("[role=alert] .toast").length).toBe(1);
  announcer.element.querySelector("button")!.click();
  expect(announcer.element.querySelectorAll(".toast").length).toBe(0);
});

it("exactly one choice is taken", () => {
  const change = vi.fn();
  const { element } = choices(
    "Look",
    [
      ["a", "A"],
      ["b", "B"],
    ] as const,
    "a",
    change,
  );
  (element.children[1] as HTMLElement).click();
  expect([...element.children].map((b) => b.getAttribute("aria-pressed"))).toEqual(["false", "true"]);
  expect(change).toHaveBeenCalledWith("b");
});
