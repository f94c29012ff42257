// What makes the page alive: faces that come and go softly, blinks, eyes that follow the pointer, and a first turn.

import { on } from "./controls";
import { enliven, type Life } from "./alive";
import { type Avatar, copyFace, type Face } from "./avatar";
import { beyondFilmed, presets, rangeOf, setNamed } from "./named";
import { element, find, readable } from "./page_sliders";
import type { Viewer } from "./viewer";

/** Most and least faces that have a button. */
const MOST_FACES = 8, LEAST_FACES = 5;
/** How far a face goes beyond what was filmed when its button says so, and when it has none. */
const TOLD_BEYOND = 0.5, MOST_BEYOND = 0.75;
/** Time in which a face goes two thirds of its way, that of the eyes, and how long the first turn takes, in seconds. */
const SOFT = 0.07, EYES = 0.12, FIRST = 1.6;
/** Turn of the camera when the page opens, in radians, to the side of the head that the camera saw, and seconds after which eyes look ahead again. */
const ASIDE = 0.25, BORED = 4;

export interface Alive {
  /** Goes softly to a face; to the person at rest without a name. */
  show(name?: string): void;
  /** Stops on the way to a face, because something else moves it. */
  stop(): void;
}

export function addLife(viewer: Viewer, moveSliders: () => void): Alive {
  const idle = find<HTMLInputElement>("idle"), gaze = find<HTMLInputElement>("gaze"), { canvas, avatar, face } = viewer;
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches, buttons = new Map<string, HTMLButtonElement>();
  const side = viewer.view(1, 1).head[2] > 0 ? -ASIDE : ASIDE;
  const life: Life = { idle: false, pointer: null };
  let goal: Face | null = null, shown: string | undefined, at = [0, 0], aim = [0, 0], moved = -BORED, before = 0, waiting = 0, first = calm ? 0 : FIRST;
  viewer.alive = (drawn) => enliven(drawn, avatar, life, performance.now() / 1000);

  const beat = (now: number) => {
    const passed = (now - before) / 1000, step = Math.min(passed, 0.1);
    before = now;
    if (!goal && !first && !life.idle && !life.pointer) return void (waiting = 0);
    waiting = requestAnimationFrame(beat);
    if (life.pointer) {
      const share = 1 - Math.exp(-step / EYES), to = now / 1000 - moved < BORED ? aim : [0, 0];
      life.pointer = at = at.map((value, k) => value + share * (to[k] - value)) as [number, number];
    }
    if (first) {
      // A page that draws slowly shows it, too.
      first = Math.max(first - Math.min(passed, 0.3), 0);
      viewer.yaw = side * (first / FIRST) ** 3;
    }
    if (goal) {
      const share = 1 - Math.exp(-step / SOFT);
      let most = 0;
      for (const part of ["expression", "joints", "head_rotation", "head_translation"] as const)
        goal[part].forEach((value, k) => {
          most = Math.max(most, Math.abs(value - face[part][k]));
          face[part][k] += share * (value - face[part][k]);
        });
      if (most < 0.004) {
        viewer.take(goal);
        goal = null;
        moveSliders();
      }
    }
    if (!viewer.playing) viewer.change();
  };
  const wake = () => {
    before = performance.now();
    waiting ||= requestAnimationFrame(beat);
  };
  const choose = () => {
    life.idle = idle.checked;
    life.pointer = gaze.checked ? [0, 0] : null;
    viewer.change();
    wake();
  };
  const press = (name?: string) => {
    shown = name;
    buttons.forEach((button, of) => button.setAttribute("aria-pressed", `${of === name}`));
  };
  const stop = () => {
    goal = null;
    press();
  };
  const show = (name?: string) => {
    viewer.play(false);
    viewer.onMotion();
    press(name === shown ? undefined : name);
    goal = copyFace(avatar.neutral);
    if (shown) setNamed(avatar, goal, new Map(), shown, 1);
    if (calm) {
      viewer.take(goal);
      goal = null;
      moveSliders();
    } else wake();
  };
  for (const name of facesOf(avatar)) {
    const label = readable(name), button = element("button", { "aria-pressed": "false" }, label[0].toUpperCase() + label.slice(1));
    if (beyondFilmed(avatar, name) > TOLD_BEYOND) button.title = "Goes beyond what was filmed, so it may look less like the person";
    on(button, "click", () => show(name));
    buttons.set(name, button);
    find("faces").append(button);
  }
  on(window, "pointermove", (event) => {
    const box = canvas.getBoundingClientRect();
    const share = (place: number, from: number, size: number) => Math.min(Math.max((2 * (place - from)) / Math.max(size, 1) - 1, -1), 1);
    aim = [share(event.clientX, box.left, box.width), -share(event.clientY, box.top, box.height)];
    moved = performance.now() / 1000;
  });
  // A drag goes on from where the head is. A key comes with the head seen from the front.
  on(window, "pointerdown wheel keydown", (event) => {
    if (first && event.type === "keydown") viewer.yaw = 0;
    first = 0;
  }, { passive: true });
  for (const box of [idle, gaze]) on(box, "change", choose);
  idle.checked = gaze.checked = !calm;
  choose();
  on(document, "keydown", (event) => {
    const digit = Number(event.key);
    if (digit && !(event.target instanceof HTMLInputElement)) [...buttons.values()][digit - 1]?.click();
  });
  // What was filmed plays once.
  viewer.loop = false;
  if (!calm) viewer.play();
  return { show, stop };
}

/** The faces that have a button: those that go least beyond what was filmed, in the order of the table. */
function facesOf(avatar: Avatar): string[] {
  const all = Object.keys(presets).filter((name) => rangeOf(avatar, name)), beyond = new Map(all.map((name) => [name, beyondFilmed(avatar, name)]));
  const least = [...all].sort((one, other) => beyond.get(one)! - beyond.get(other)!).slice(0, LEAST_FACES);
  return all.filter((name) => beyond.get(name)! <= MOST_BEYOND || least.includes(name)).slice(0, MOST_FACES);
}
