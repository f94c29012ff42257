// A webcam as a driver: MediaPipe's face landmarker in a worker, relative to one's own neutral face, smoothed.

import { Detector, WebcamError, type DetectorParts } from "./detector";
import { Follower, type Found, type Reading } from "./follower";
import { transfer } from "./transfer";
import type { Viewer } from "./viewer";

export { WebcamError } from "./detector";
export type { DetectorParts } from "./detector";
export { Follower } from "./follower";
export type { Found, Reading } from "./follower";
export { OneEuro } from "./one_euro";
export type { Smoothing } from "./one_euro";

export type WebcamState = "off" | "opening" | "calibrating" | "running" | "no face";

/** What a page says in each state. */
export const WORDS: Record<WebcamState, string> = {
  off: "",
  opening: "Opening the camera. Allow it if the browser asks.",
  calibrating: "Look straight ahead with a relaxed face for a second.",
  running: "The avatar follows your face.",
  "no face": "No face is seen. Look into the camera, in good light.",
};

/** Milliseconds without a face after which the state says so. */
const LOST_AFTER = 1000;

export class Webcam {
  /** The camera's picture, for a preview. */
  readonly video = document.createElement("video");
  /** Called with each face, after the avatars have taken it. */
  onReading: (reading: Reading) => void = () => {};
  /** Called when the state changes. `why` is set when the camera has stopped by itself. */
  onState: (state: WebcamState, why?: string) => void = () => {};

  private current: WebcamState = "off";
  private run = 0;
  private seen = 0;
  private send: () => void = () => {};
  private readonly detector: Detector;
  private follower = new Follower();
  private readonly viewers = new Set<Viewer>();
  private readonly hide = () => document.hidden && this.stop("The camera is off, because the page was hidden.");
  private readonly leave = () => this.stop();

  /** `parts` is called at the first start, so that a page loads nothing large before. */
  constructor(parts: () => DetectorParts | Promise<DetectorParts>) {
    this.detector = new Detector(parts);
    this.detector.onFound = (found) => this.current !== "off" && this.current !== "opening" && this.take(found);
    this.detector.onError = (why) => this.stop(why);
    this.video.muted = this.video.playsInline = true;
  }

  get state(): WebcamState {
    return this.current;
  }

  /** Whether left and right are exchanged, as in a mirror; at first they are. */
  get mirrored(): boolean {
    return this.follower.mirrored;
  }

  set mirrored(mirrored: boolean) {
    this.follower.mirrored = mirrored;
  }

  /**
   * Asks for the camera, and starts. The first second is taken as the neutral face.
   * @throws WebcamError if there is no camera, or it may not be used.
   */
  async start(): Promise<void> {
    if (this.current !== "off") return;
    const run = ++this.run;
    this.become("opening");
    try {
      const stream = await camera();
      if (run !== this.run) return stop(stream);
      this.video.srcObject = stream;
      stream.getVideoTracks()[0].addEventListener("ended", () => this.stop("The camera was taken away or switched off."));
      document.addEventListener("visibilitychange", this.hide);
      addEventListener("pagehide", this.leave);
      await Promise.all([this.video.play(), this.detector.open()]);
      if (run !== this.run) return;
    } catch (error) {
      if (run !== this.run) return; // stopped while it opened
      this.stop();
      throw error instanceof WebcamError ? error : new WebcamError(`The camera cannot be used: ${(error as Error).message ?? error}`);
    }
    const { mirrored } = this;
    this.follower = new Follower();
    this.mirrored = mirrored;
    this.seen = performance.now();
    this.become("calibrating");
    this.watch(run);
  }

  /** Switches the camera off. */
  stop(why?: string): void {
    if (this.current === "off") return;
    ++this.run;
    stop(this.video.srcObject as MediaStream | null);
    this.video.srcObject = null;
    document.removeEventListener("visibilitychange", this.hide);
    removeEventListener("pagehide", this.leave);
    this.become("off", why);
  }

  /** Takes the face of the next second as the neutral one. */
  calibrate(): void {
    if (this.current === "off") return;
    this.follower.calibrate();
    this.become("calibrating");
  }

  /** Drives an avatar, until the function that it returns is called. A motion that plays has precedence. */
  attach(viewer: Viewer): () => void {
    this.viewers.add(viewer);
    return () => void this.viewers.delete(viewer);
  }

  private become(state: WebcamState, why?: string): void {
    if (state === this.current && !why) return;
    this.current = state;
    this.onState(state, why);
  }

  /** Sends each new picture to the worker. Pictures that come while it works are left out. */
  private watch(run: number): void {
    const { video } = this;
    let newest = 0, sent = 0;
    this.send = () => {
      if (this.run !== run || this.detector.busy || newest <= sent) return;
      sent = newest;
      this.detector.see(() => createImageBitmap(video), newest);
    };
    // Firefox has the first since version 132. The second may send a picture twice.
    const wait = () => ("requestVideoFrameCallback" in video ? video.requestVideoFrameCallback(see) : requestAnimationFrame(see));
    const see = (now: number) => {
      if (this.run !== run) return;
      newest = now;
      this.send();
      wait();
    };
    wait();
  }

  private take(found: Found): void {
    this.send();
    if (found.scores) this.seen = found.milliseconds;
    else if (found.milliseconds - this.seen > LOST_AFTER) this.become("no face");
    const reading = this.follower.follow(found);
    if (found.scores) this.become(this.follower.calibrating ? "calibrating" : "running");
    if (!reading) return;
    for (const viewer of this.viewers) {
      if (viewer.playing) continue;
      transfer(reading.scores, reading.turn, viewer.avatar, viewer.face, reading.shift);
      viewer.change();
    }
    this.onReading(reading);
  }
}

const stop = (stream: MediaStream | null) => stream?.getTracks().forEach((track) => track.stop());

/** Opens the camera that faces the user, or says why not in words that help. */
export async function camera(video: MediaTrackConstraints = { width: { ideal: 640 }, height: { ideal: 480 } }): Promise<MediaStream> {
  if (!navigator.mediaDevices?.getUserMedia)
    throw new WebcamError(
      location.protocol === "file:"
        ? "This browser gives no camera to a page from a file. Open the file with Chrome or Edge, or put it on a web server with https."
        : location.protocol === "http:"
          ? "Browsers give a camera only to pages with https. Open this page by its https address."
          : "This browser gives no camera to this page. Open it with another browser.",
    );
  try {
    return await navigator.mediaDevices.getUserMedia({ audio: false, video: { facingMode: "user", frameRate: { ideal: 30 }, ...video } });
  } catch (error) {
    const { name, message } = error as DOMException;
    const words: Record<string, string> = {
      NotAllowedError: `The camera is not allowed. Allow it for this page (the camera sign beside the address), and press the button again.${window === top ? "" : ' The frame around this page needs allow="camera".'}`,
      NotFoundError: "There is no camera. Connect one, and press the button again.",
      NotReadableError: "The camera does not answer. Close other programs that use it, and press the button again.",
    };
    const same: Record<string, string> = { SecurityError: "NotAllowedError", OverconstrainedError: "NotFoundError", DevicesNotFoundError: "NotFoundError", AbortError: "NotReadableError" };
    throw new WebcamError(words[same[name] ?? name] ?? `The camera cannot be used: ${message || name}`);
  }
}
