// What a page and the element share: turning by hand, and a canvas that is as sharp as a device can afford.

import type { Viewer } from "./viewer";

/** Most pixels of a picture: more would make telephones stutter. */
const MOST_PIXELS = 1_600_000;

/** Listens to events, whose names are apart by blanks. */
export const on = (target: EventTarget, names: string, act: (event: any) => void, options?: AddEventListenerOptions): void =>
  names.split(" ").forEach((name) => target.addEventListener(name, act, options));

/** One finger or the mouse turns, two fingers or the wheel zoom, arrow keys turn. `keys` is where keys are heard. */
export function addTurning(viewer: Viewer, keys: EventTarget = viewer.canvas): void {
  const { canvas } = viewer, pointers = new Map<number, { x: number; y: number }>();
  const span = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  on(canvas, "pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  on(canvas, "pointerup pointercancel", (event) => pointers.delete(event.pointerId));
  on(canvas, "pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const apart = pointers.size === 2 ? span() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (apart) viewer.zoom *= span() / apart;
    else {
      viewer.yaw -= (event.clientX - last.x) * 0.008;
      viewer.pitch += (event.clientY - last.y) * 0.008;
    }
    viewer.look();
  });
  on(canvas, "wheel", (event) => {
    event.preventDefault();
    viewer.zoom *= Math.exp(-0.0015 * event.deltaY);
    viewer.look();
  }, { passive: false });
  on(keys, "keydown", (event) => {
    const turns: Record<string, () => void> = {
      ArrowLeft: () => (viewer.yaw += 0.1), ArrowRight: () => (viewer.yaw -= 0.1),
      ArrowUp: () => (viewer.pitch -= 0.1), ArrowDown: () => (viewer.pitch += 0.1),
      "+": () => (viewer.zoom *= 1.1), "-": () => (viewer.zoom /= 1.1),
    };
    if (!turns[event.key] || isTyping(event)) return;
    event.preventDefault();
    turns[event.key]();
    viewer.look();
  });
}

/** Gives the canvas the number of pixels that suits its size on the screen. */
export function fit(viewer: Viewer): void {
  const { canvas } = viewer, { width, height } = canvas.getBoundingClientRect();
  const ratio = Math.min(devicePixelRatio, 2, Math.sqrt(MOST_PIXELS / Math.max(width * height, 1)));
  const [w, h] = [width, height].map((size) => Math.max(1, Math.round(size * ratio)));
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
    // At once, since another size clears the canvas: drawn a moment later, the head would flicker.
    viewer.draw();
  }
}

/** Whether a key belongs to the control that has the focus, such as a slider. */
export const isTyping = ({ target, ctrlKey, metaKey, altKey }: KeyboardEvent): boolean =>
  ctrlKey || metaKey || altKey || (target instanceof Element && target.matches("input, select, textarea"));
