import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { meshMessage } from "../mock/face.mjs";
import { Client } from "../src/api/client";
import { advance, Barrier } from "../src/replay/lock_step";
import { Player } from "../src/replay/player";
import { neighbourSpeed, SPEEDS } from "../src/replay/transport";
import { sparkPath } from "../src/plot/sparkline";
import { FakeSocket } from "./fake_socket";

describe("a clock", () => {
  const pace = { speed: 0.5, reverse: false, loop: false, lengthSeconds: 2 };

  it("goes at its speed, either way", () => {
    expect(advance(1, 0.04, pace).time).toBeCloseTo(1.02, 9);
    expect(advance(1, 0.04, { ...pace, reverse: true }).time).toBeCloseTo(0.98, 9);
  });

  it("stops at its ends, or begins again", () => {
    expect(advance(1.999, 0.1, pace)).toEqual({ time: 2, ended: true });
    expect(advance(0.001, 0.1, { ...pace, reverse: true })).toEqual({ time: 0, ended: true });
    expect(advance(1.999, 0.1, { ...pace, loop: true })).toEqual({ time: 0, ended: false });
    expect(advance(0.001, 0.1, { ...pace, reverse: true, loop: true })).toEqual({ time: 2, ended: false });
  });

  it("does not leap after the page slept", () => {
    expect(advance(0, 60, pace).time).toBeCloseTo(0.05, 9);
  });
});

it("a barrier opens when the last side arrives, once", () => {
  const barrier = new Barrier(2);
  barrier.ask();
  expect([barrier.arrived(1), barrier.waiting, barrier.arrived(1), barrier.arrived(0)]).toEqual([
    false,
    true,
    false,
    true,
  ]);
  expect(barrier.arrived(0)).toBe(false);
});

it("speeds step from one to the next and stay within", () => {
  expect(neighbourSpeed(1, 1)).toBe(2);
  expect(neighbourSpeed(1, -1)).toBe(0.5);
  expect(neighbourSpeed(SPEEDS[0], -1)).toBe(SPEEDS[0]);
  expect(neighbourSpeed(4, 1)).toBe(4);
});

it("a small curve breaks where there is nothing", () => {
  expect(sparkPath([1, null, 1]).match(/M/g)?.length).toBe(2);
  expect(sparkPath([null, null])).toBe("");
});

describe("a replay", () => {
  beforeEach(() => {
    FakeSocket.all = [];
    vi.stubGlobal("WebSocket", FakeSocket);
    vi.stubGlobal("createImageBitmap", async () => ({ close: () => undefined }));
  });
  afterEach(() => {
    vi.unstubAllGlobals();
  });

  it("does not jump back by pictures that were under way when it was sought", async () => {
    const shown: [number, boolean][] = [];
    const mesh = ({ message }: { message: { timeSeconds: number } }, isLate: boolean) =>
      shown.push([message.timeSeconds, isLate]);
    const handlers = { mesh, changed: () => undefined, fault: (error: unknown) => expect(error).toBeNull() };
    const player = new Player(new Client(), "s", "scan", 10, 2, handlers);
    const socket = FakeSocket.all[0]!;
    socket.readyState = 1;
    socket.onopen!();
    let sequence = 0;
    const send = async (seconds: number) => {
      const { buffer, byteOffset, length } = meshMessage({
        sequence: (sequence += 1),
        seconds,
        maxVertices: 100,
        scalars: "none",
        full: true,
      });
      socket.onmessage!({ data: buffer.slice(byteOffset, byteOffset + length) });
      await new Promise((resolve) => setTimeout(resolve));
    };
    // The daemon's own beginning, then what was asked for.
    await send(0);
    await send(2);
    player.play();
    player.seek(7);
    await send(2.03);
    expect(player.timeSeconds).toBe(7);
    // A second place while the first is owed.
    player.seek(5);
    await send(7);
    await send(7.03);
    expect(player.timeSeconds).toBe(5);
    await send(5);
    await send(5.03);
    expect(player.timeSeconds).toBe(5.03);
    const late = shown.filter(([, isLate]) => isLate).map(([seconds]) => seconds);
    expect(late).toEqual([0, 2.03, 7.03]);
    expect(socket.sent.filter((text) => text.includes("ack")).length).toBe(sequence);
    player.close();
  });
});
