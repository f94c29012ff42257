// The page that `mien export --out NAME.html` writes: a living avatar, buttons for faces, and more behind a button.

import { motionLength } from "./avatar";
import { addTurning, fit, isTyping, on } from "./controls";
import { AvatarError, readPacked } from "./format";
import { addLife, type Alive } from "./page_life";
import { addSliders, find } from "./page_sliders";
import { contextOf } from "./renderer";
import { readSeries, textOf } from "./series";
import { Viewer } from "./viewer";
import type { BackendName } from "./webgpu";

/** How long a message stays, in milliseconds. */
const MESSAGE_STAYS = 9000;

let clearing = 0;
/** Shows a message, which goes away by itself. */
function say(text: string, stays = false): void {
  find("message").textContent = text;
  clearTimeout(clearing);
  if (!stays) clearing = window.setTimeout(() => say("", true), MESSAGE_STAYS);
}

/** Play, pause, and a time line, while there is a motion. Files that are chosen or dropped become the motion. */
function addMotion(viewer: Viewer, moveSliders: () => void, stop: () => void): void {
  const button = find("play"), time = find<HTMLInputElement>("time"), file = find<HTMLInputElement>("file");
  const show = () => (button.textContent = viewer.playing ? "Pause" : "Play");
  const take = () => {
    button.hidden = find("motion").hidden = !viewer.motion;
    if (viewer.motion) time.max = `${motionLength(viewer.motion) - 1}`;
  };
  take();
  viewer.onMotion = () => {
    time.value = `${viewer.timestep}`;
    moveSliders();
    show();
  };
  const toggle = () => {
    stop();
    viewer.loop = true;
    viewer.play(!viewer.playing);
    show();
  };
  on(button, "click", toggle);
  on(document, "keydown", (event) => {
    if (event.key !== " " || isTyping(event) || event.target instanceof HTMLButtonElement) return;
    event.preventDefault();
    toggle();
  });
  on(time, "input", () => {
    stop();
    viewer.play(false);
    viewer.seek(Number(time.value));
  });
  on(find("panel"), "input", show);
  const open = async (given: File | undefined) => {
    if (!given) return;
    say("");
    try {
      const notes: string[] = [];
      viewer.setMotion(readSeries(textOf(await given.arrayBuffer()), viewer.avatar, notes));
      say(notes.map((note) => `${given.name} ${note}.`).join(" "));
      take();
      toggle();
    } catch (error) {
      say(`${given.name} ${error instanceof AvatarError ? error.message : "cannot be read"}. Give a csv of Live Link Face, or blend shapes as json.`);
    }
  };
  on(find("open"), "click", () => file.click());
  on(file, "change", () => open(file.files?.[0]));
  on(window, "dragover", (event) => event.preventDefault());
  on(window, "drop", (event) => {
    event.preventDefault();
    open(event.dataTransfer?.files[0]);
  });
}

function addRest(viewer: Viewer, alive: Alive): void {
  on(find("reset"), "click", () => {
    alive.stop();
    viewer.play(false);
    viewer.reset();
    viewer.onMotion();
  });
  const { classList } = document.documentElement, more = find("more"), full = find("full");
  // Around: the page's own light, white, black.
  on(find("background"), "click", () => {
    const [grey, , , opaque] = viewer.background, next = opaque ? 0 : 1;
    viewer.background = [next, next, next, opaque && !grey ? 0 : 1];
    viewer.look();
  });
  // NAME.html#transparent shows the head alone, for a frame in another page.
  classList.toggle("bare", location.hash === "#transparent");
  const open = (opened: boolean) => {
    classList.toggle("open", opened);
    find("panel").hidden = !opened;
    more.setAttribute("aria-expanded", `${opened}`);
  };
  on(more, "click", () => open(!classList.contains("open")));
  on(document, "keydown", (event) => event.key === "Escape" && open(false));
  // The head alone fills the screen. Telephones of Apple cannot do that.
  full.hidden = !document.fullscreenEnabled;
  on(full, "click", () => find("stage").requestFullscreen());
  on(window, "pointerdown", () => find("hint").remove(), { once: true });
}

async function open(): Promise<Viewer> {
  const text = find("avatar").textContent!.trim();
  const reading = readPacked(Uint8Array.from(atob(text), (c) => c.charCodeAt(0))), canvas = find<HTMLCanvasElement>("view");
  // `mien export --webgpu` puts webgpu.ts into the page. NAME.html#webgl2 and NAME.html#webgpu choose by hand.
  const { mienWebGpu } = window as unknown as { mienWebGpu?: typeof import("./webgpu") };
  const named = /^#(webgl2|webgpu)$/.exec(location.hash)?.[1] as BackendName | undefined;
  // The GPU starts while the avatar is unpacked.
  if (!mienWebGpu) contextOf(canvas);
  const { avatar, motion } = await reading;
  const viewer = new Viewer(canvas, avatar, motion, await mienWebGpu?.findBackend(named));
  let alive: Alive | undefined;
  const stop = () => alive?.stop();
  const moveSliders = addSliders(viewer, find("sliders"), () => {
    stop();
    viewer.play(false);
  });
  moveSliders();
  addTurning(viewer, document);
  addMotion(viewer, moveSliders, stop);
  alive = addLife(viewer, moveSliders);
  addRest(viewer, alive);
  new ResizeObserver(() => fit(viewer)).observe(viewer.canvas);
  fit(viewer);
  find("hint").hidden = false;
  return viewer;
}

/** Scripts of the page reach the viewer by `await mien`. */
(window as unknown as { mien: Promise<Viewer> }).mien = open().catch((error) => {
  say(error instanceof AvatarError ? `This avatar ${error.message}.` : `This page cannot show its avatar: ${error.message ?? error}`, true);
  throw error;
});
