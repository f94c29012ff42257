// What `mien export --webcam` adds to the page: the button, and the detector's files, which are unpacked when it is pressed.

import type { Viewer } from "./viewer";
import { Webcam, WebcamError, WORDS, type DetectorParts } from "./webcam";

const find = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;

/** A file in the page: base64 around gzip. */
async function unpacked(name: string): Promise<ArrayBuffer> {
  const place = find(`webcam-${name}`), text = atob(place.textContent!.trim()), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; ++i) bytes[i] = text.charCodeAt(i);
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function parts(): Promise<DetectorParts> {
  return { vision: await unpacked("vision"), loader: await unpacked("loader"), wasm: await unpacked("wasm"), model: await unpacked("model") };
}

function addCamera(viewer: Viewer): Webcam {
  const { content } = find<HTMLTemplateElement>("camera-template"), [first, card, notices] = content.children;
  find("more").before(first);
  find("faces").before(card);
  find("panel").append(notices);
  (card as HTMLElement).hidden = true;
  const webcam = new Webcam(parts), button = find<HTMLButtonElement>("camera"), neutral = find<HTMLButtonElement>("neutral");
  const mirrored = find<HTMLInputElement>("mirrored"), preview = find<HTMLInputElement>("preview"), told = find("camera-state");
  const more = find("camera-more"), { video } = webcam;
  webcam.attach(viewer);
  webcam.onReading = () => viewer.playing || viewer.onMotion();
  video.hidden = true;
  video.setAttribute("aria-label", "Your camera's picture");
  more.append(video);
  const show = () => {
    webcam.mirrored = mirrored.checked;
    video.classList.toggle("mirrored", mirrored.checked);
    video.hidden = !preview.checked;
  };
  mirrored.addEventListener("change", show);
  preview.addEventListener("change", show);
  show();
  /** Other drivers rest while the camera drives, and go on after it. */
  const others = ["idle", "gaze"].map((id) => find<HTMLInputElement>(id)), resting = new Set<HTMLInputElement>();
  const tell = (text: string) => {
    told.textContent = text;
    (card as HTMLElement).hidden = !text;
  };
  webcam.onState = (state, why) => {
    const on = state !== "off";
    button.textContent = on ? "Stop" : "Be me";
    more.hidden = !on;
    tell(why ?? WORDS[state]);
    for (const box of others) {
      if (on && box.checked) {
        resting.add(box);
        box.click();
      }
      box.disabled = on;
      if (!on && resting.delete(box)) box.click();
    }
    if (on || viewer.playing) return;
    viewer.take(viewer.avatar.neutral);
    viewer.onMotion();
  };
  button.addEventListener("click", async () => {
    if (webcam.state !== "off") return webcam.stop();
    viewer.play(false);
    viewer.onMotion();
    try {
      await webcam.start();
    } catch (error) {
      tell(error instanceof WebcamError ? error.message : `${error}`);
    }
  });
  neutral.addEventListener("click", () => webcam.calibrate());
  return webcam;
}

const page = window as unknown as { mien: Promise<Viewer>; webcam: Promise<Webcam> };
/** Scripts of the page reach the camera by `await webcam`. */
page.webcam = page.mien.then(addCamera);
