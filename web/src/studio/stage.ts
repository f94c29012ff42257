// The stage: the camera, a film, the living avatar, the growing one, or nothing yet.

import { addTurning, fit } from "../controls";
import { readMien } from "../format";
import { Viewer } from "../viewer";
import { Webcam } from "../webcam";
import { ask, person } from "./api";
import { PARTS } from "./filming";
import { attempt, button, find } from "./page";
import { now } from "./state";

let viewer: Viewer | null = null;
/** Address of the avatar on the stage's canvas. */
let shown = "";
/** The camera that drives the avatar. */
export const webcam = new Webcam(() => PARTS);
let detach = () => {};

/** Shows on the stage what there is: the camera, a film, the living avatar, the growing one, or nothing yet. */
export function showStage(): void {
  if (!now.whole) return;
  const { takings, name, progress, made } = now.whole, making = progress.state === "making";
  const driven = webcam.state !== "off", living = made && !making && takings.some((each) => each.kind === "page") ? person(name, "take", "page") : "";
  const shows = now.filming ? "camera" : driven ? "grown" : now.chosen ? "review" : living ? "living" : making && now.whole.growing ? "grown" : making && now.whole.fit && progress.stage?.name === "tracking" ? "fit" : now.whole.face ? "poster" : "empty";
  for (const id of ["review", "living", "grown", "fit", "poster", "empty"]) find(id).hidden = id !== shows;
  for (const id of ["camera", "rings", "bar"]) find(id).toggleAttribute("hidden", shows !== "camera");
  find("words").hidden = !now.filming && !driven;
  const recording = now.filming?.recording ?? false;
  button("record").hidden = recording;
  button("finish").hidden = !recording;
  button("cancel").textContent = recording ? "Throw away" : "Close the camera";
  if (!now.filming) find("fault").hidden = true;
  show<HTMLVideoElement>("review", shows === "review" ? person(name, "films", now.chosen) : "");
  show<HTMLIFrameElement>("living", shows === "living" ? `${living}?${now.whole.changed}` : "");
  show<HTMLIFrameElement>("fit", shows === "fit" ? `${person(name, "fit")}?${now.whole.fit}` : "");
  show<HTMLImageElement>("poster", shows === "poster" ? `${person(name, "face")}?${now.whole.face}` : "");
  find("poster").classList.toggle("developing", making);
  if (shows === "grown" && !driven) void attempt(() => showAvatar(`${person(name, "growing")}?${now.whole!.growing}`));
}

/** Sets what a frame, a picture or a film shows, unless it shows that already. */
function show<T extends HTMLElement & { src: string }>(id: string, source: string): void {
  const place = find<T>(id);
  if ((place.getAttribute("src") ?? "") === source) return;
  if (source) place.src = source;
  else place.removeAttribute("src");
}

/** Shows an avatar on the stage's canvas, in the view that was chosen for the last one. */
async function showAvatar(address: string): Promise<void> {
  if (address === shown) return;
  shown = address;
  const answer = await fetch(address);
  if (!answer.ok) return;
  const canvas = find<HTMLCanvasElement>("grown"), { yaw, pitch, zoom } = viewer ?? { yaw: 0, pitch: 0, zoom: 1 };
  const next = readMien(await answer.arrayBuffer());
  viewer?.dispose();
  const fresh = canvas.cloneNode() as HTMLCanvasElement;
  canvas.replaceWith(fresh);
  viewer = new Viewer(fresh, next);
  Object.assign(viewer, { yaw, pitch, zoom });
  addTurning(viewer, fresh);
  fit(viewer);
  viewer.look();
}

/** Lets the avatar follow the face in front of the camera, or ends that. */
export async function beMe(): Promise<void> {
  if (webcam.state !== "off") return webcam.stop();
  const { name, takings } = now.whole!;
  if (!takings.find(({ kind }) => kind === "mien")?.ready) await ask("POST", person(name, "take", "mien"), {});
  now.chosen = "";
  const starting = webcam.start();
  showStage();
  await Promise.all([starting, showAvatar(person(name, "take", "mien"))]);
  detach();
  detach = webcam.attach(viewer!);
}

/** Clears the stage for another person. */
export function clearStage(): void {
  webcam.stop();
  now.chosen = shown = "";
  viewer?.dispose();
  viewer = null;
}

addEventListener("resize", () => viewer && fit(viewer));
