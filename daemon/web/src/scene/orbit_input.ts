import type { Orbit } from "./orbit";

const TURN_RAD_PER_SIDE = Math.PI;
const KEY_TURN_RAD = Math.PI / 36;
const KEY_PAN = 0.05;
const KEY_ZOOM = 1.1;

interface Touch {
  x: number;
  y: number;
}

/** Turns, moves and zooms by mouse, pen, fingers and keys on an element. */
export function bindOrbit(element: HTMLElement, orbit: Orbit): void {
  const pointers = new Map<number, Touch>();
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  element.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, touch]) => touch);
    const side = Math.min(element.clientWidth, element.clientHeight) || 1;
    if (others[0]) pinch(orbit, before, now, others[0], side);
    else drag(orbit, event, (now.x - before.x) / side, (now.y - before.y) / side);
    pointers.set(event.pointerId, now);
  });
  const up = (event: PointerEvent) => pointers.delete(event.pointerId);
  element.addEventListener("pointerup", up);
  element.addEventListener("pointercancel", up);
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      orbit.zoom(Math.exp(Math.max(-100, Math.min(100, event.deltaY)) * 0.002));
    },
    { passive: false },
  );
  element.addEventListener("keydown", (event) => {
    if (pressed(orbit, event)) event.preventDefault();
  });
}

function drag(orbit: Orbit, event: PointerEvent, dx: number, dy: number): void {
  const moves = (event.buttons & 6) !== 0 || event.shiftKey;
  if (moves) orbit.pan(-dx, dy);
  else orbit.turn(-dx * TURN_RAD_PER_SIDE, dy * TURN_RAD_PER_SIDE);
}

/** One of two fingers moved: half of the move pans, the change of distance zooms. */
function pinch(orbit: Orbit, before: Touch, now: Touch, other: Touch, side: number): void {
  const distance = (a: Touch) => Math.max(10, Math.hypot(a.x - other.x, a.y - other.y));
  orbit.zoom(distance(before) / distance(now));
  orbit.pan(-(now.x - before.x) / 2 / side, (now.y - before.y) / 2 / side);
}

function pressed(orbit: Orbit, { key, shiftKey, ctrlKey, metaKey, altKey }: KeyboardEvent): boolean {
  if (ctrlKey || metaKey || altKey) return false;
  const direction = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
  if (direction) {
    const [x, y] = direction as [number, number];
    if (shiftKey) orbit.pan(x * KEY_PAN, y * KEY_PAN);
    else orbit.turn(x * KEY_TURN_RAD, y * KEY_TURN_RAD);
  } else if (key === "+" || key === "=") orbit.zoom(1 / KEY_ZOOM);
  else if (key === "-") orbit.zoom(KEY_ZOOM);
  else if (key === "0") orbit.reset();
  else return false;
  return true;
}
