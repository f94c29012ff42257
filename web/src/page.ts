// The page that `mien export --out NAME.html` writes: the avatar on a canvas, sliders by group, the packed motion.

import { enliven, type Life } from "./alive";
import { motionLength } from "./avatar";
import { addTurning, fit } from "./controls";
import { AvatarError, readPacked } from "./format";
import { readSeries } from "./series";
import { Viewer } from "./viewer";
import type { BackendName } from "./webgpu";

const GROUPS: [string, RegExp][] = [
  ["Jaw", /^jaw|^tongue/],
  ["Mouth", /^mouth/],
  ["Eyes", /^eye/],
  ["Brows", /^brow/],
  ["Cheeks and nose", /^cheek|^nose/],
  ["Other", /./],
];
const AXES = ["nod", "turn", "tilt"];
/** Largest angle of a slider of a joint, in radians. */
const MOST_ANGLE = 0.5;

const find = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;

function element<K extends keyof HTMLElementTagNameMap>(name: K, attributes: Record<string, string>, ...inside: (Node | string)[]) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...inside);
  return made;
}

/** jawOpen -> jaw open. */
const readable = (name: string) => name.replace(/_/g, " ").replace(/([a-z])([A-Z])/g, (_, a, b) => `${a} ${b.toLowerCase()}`);

/** Sliders of all expressions and joints. Returns a function that moves them to the face that is shown. */
function addSliders(viewer: Viewer, place: HTMLElement): () => void {
  const updates: (() => void)[] = [];
  const slider = (label: string, id: string, [least, most]: number[], get: () => number, set: (value: number) => void) => {
    const input = element("input", { type: "range", id, min: `${least}`, max: `${most}`, step: "0.01" });
    input.addEventListener("input", () => {
      viewer.play(false);
      set(Number(input.value));
      viewer.change();
    });
    updates.push(() => (input.value = `${get()}`));
    return element("label", { for: id }, element("span", {}, label), input);
  };
  const { avatar, face } = viewer, names = avatar.expression_names;
  const taken = new Set<string>();
  for (const [title, pattern] of GROUPS) {
    const rows: HTMLElement[] = [];
    names.forEach((name, index) => {
      const bounds = [...avatar.expression_bounds.subarray(2 * index, 2 * index + 2)];
      if (taken.has(name) || !pattern.test(name) || bounds[0] === bounds[1]) return;
      taken.add(name);
      rows.push(slider(readable(name), name, bounds, () => face.expression[index], (value) => (face.expression[index] = value)));
    });
    if (rows.length) place.append(element("details", {}, element("summary", {}, title), ...rows));
  }
  const joints = avatar.joint_names.flatMap((name, joint) =>
    AXES.map((axis, k) => {
      const at = 3 * joint + k, id = `${name}_${"xyz"[k]}`;
      return slider(`${readable(name)} ${axis}`, id, [-MOST_ANGLE, MOST_ANGLE], () => face.joints[at], (value) => (face.joints[at] = value));
    }),
  );
  if (joints.length) place.append(element("details", {}, element("summary", {}, "Joints"), ...joints));
  place.querySelector("details")?.setAttribute("open", "");
  return () => updates.forEach((update) => update());
}

/** Play, pause, and a time line, while there is a motion. Files that are chosen or dropped become the motion. */
function addMotion(viewer: Viewer, moveSliders: () => void): void {
  const button = find<HTMLButtonElement>("play"), time = find<HTMLInputElement>("time"), file = find<HTMLInputElement>("file");
  const show = () => (button.textContent = viewer.playing ? "Pause" : "Play");
  const take = () => {
    find("motion").hidden = !viewer.motion;
    if (viewer.motion) time.max = `${motionLength(viewer.motion) - 1}`;
  };
  take();
  viewer.onMotion = () => {
    time.value = `${viewer.timestep}`;
    moveSliders();
    show();
  };
  const toggle = () => {
    viewer.play(!viewer.playing);
    show();
  };
  button.addEventListener("click", toggle);
  viewer.canvas.addEventListener("keydown", (event) => {
    if (event.key !== " ") return;
    event.preventDefault();
    toggle();
  });
  time.addEventListener("input", () => {
    viewer.play(false);
    viewer.seek(Number(time.value));
  });
  find("panel").addEventListener("input", show);
  const open = async (given: File | undefined) => {
    if (!given) return;
    const message = find("message");
    message.textContent = "";
    try {
      const notes: string[] = [];
      viewer.setMotion(readSeries(await given.text(), viewer.avatar, notes));
      message.textContent = notes.map((note) => `${given.name} ${note}.`).join(" ");
      take();
      toggle();
    } catch (error) {
      message.textContent = `${given.name} ${error instanceof AvatarError ? error.message : "cannot be read"}. Give a csv of Live Link Face, or blend shapes as json.`;
    }
  };
  file.addEventListener("change", () => open(file.files?.[0]));
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    open(event.dataTransfer?.files[0]);
  });
}

/** Blinks and small movements, and eyes that follow the pointer, while no motion plays. */
function addLife(viewer: Viewer): void {
  const idle = find<HTMLInputElement>("idle"), gaze = find<HTMLInputElement>("gaze"), { canvas, avatar, face } = viewer;
  const life: Life = { idle: false, pointer: null };
  let waiting = false;
  const live = (now: number) => {
    waiting = life.idle || life.pointer !== null;
    if (!viewer.playing) {
      enliven(face, avatar, life, now / 1000);
      viewer.change();
    }
    if (waiting) requestAnimationFrame(live);
  };
  const wake = () => {
    life.idle = idle.checked;
    life.pointer = gaze.checked ? (life.pointer ?? [0, 0]) : null;
    if (!waiting) requestAnimationFrame(live);
  };
  idle.addEventListener("change", wake);
  gaze.addEventListener("change", wake);
  addEventListener("pointermove", (event) => {
    if (!life.pointer) return;
    const box = canvas.getBoundingClientRect();
    const share = (at: number, middle: number, size: number) => Math.min(Math.max((2 * (at - middle)) / Math.max(size, 1), -1), 1);
    life.pointer = [
      share(event.clientX, box.left + box.width / 2, box.width), -share(event.clientY, box.top + box.height / 2, box.height),
    ];
  });
}

function addRest(viewer: Viewer, moveSliders: () => void): void {
  find("reset").addEventListener("click", () => {
    viewer.play(false);
    viewer.reset();
    moveSliders();
    find("play").textContent = "Play";
  });
  const background = find<HTMLSelectElement>("background");
  const show = () => {
    const grey = { white: 1, black: 0 }[background.value];
    viewer.background = grey === undefined ? [0, 0, 0, 0] : [grey, grey, grey, 1];
    viewer.look();
  };
  background.addEventListener("change", show);
  // NAME.html#transparent shows the head alone, for a frame in another page.
  if (location.hash === "#transparent") {
    document.body.classList.add("bare");
    background.value = "none";
  }
  show();
  find("full").addEventListener("click", () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()));
}

async function open(): Promise<Viewer> {
  const text = find("avatar").textContent!.trim();
  const { avatar, motion } = await readPacked(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  // `mien export --webgpu` puts webgpu.ts into the page. NAME.html#webgl2 and NAME.html#webgpu choose by hand.
  const { mienWebGpu } = window as unknown as { mienWebGpu?: typeof import("./webgpu") };
  const named = /^#(webgl2|webgpu)$/.exec(location.hash)?.[1] as BackendName | undefined;
  const viewer = new Viewer(find<HTMLCanvasElement>("view"), avatar, motion, await mienWebGpu?.findBackend(named));
  const moveSliders = addSliders(viewer, find("sliders"));
  moveSliders();
  addTurning(viewer);
  addMotion(viewer, moveSliders);
  addLife(viewer);
  addRest(viewer, moveSliders);
  new ResizeObserver(() => fit(viewer)).observe(viewer.canvas);
  fit(viewer);
  return viewer;
}

/** Scripts of the page reach the viewer by `await mien`. */
(window as unknown as { mien: Promise<Viewer> }).mien = open().catch((error) => {
  find("message").textContent = error instanceof AvatarError ? `This avatar ${error.message}.` : `This page cannot show its avatar: ${error.message ?? error}`;
  throw error;
});
