// A webcam as a driver: MediaPipe's face landmarker in a worker, relative to one's own neutral face, smoothed.

import { axisAngle, multiplied, rotationMatrix, transposed } from "./rigid";
import { OneEuro, type Smoothing } from "./one_euro";
import { transfer } from "./transfer";
import type { Viewer } from "./viewer";

/** The worker's script (build.mjs). */
declare const DETECTOR: string;

/** Files of the npm package @mediapipe/tasks-vision, version 0.10.35, and the model: each by its address, or its content. */
export interface DetectorParts {
  /** vision_bundle.cjs. */
  vision: string | ArrayBuffer;
  /** wasm/vision_wasm_internal.js. */
  loader: string | ArrayBuffer;
  /** wasm/vision_wasm_internal.wasm. */
  wasm: string | ArrayBuffer;
  /** face_landmarker.task. */
  model: string | ArrayBuffer;
}

/** What the detector says about a picture. */
export interface Found {
  /** Names and strengths of blend shapes; null without a face. */
  scores: [string, number][] | null;
  /** From the face to the camera, column by column, in centimetres; +y up, +z towards the person's front. */
  matrix: number[] | null;
  /** When the picture came, on the page's clock. */
  milliseconds: number;
  /** How long the detector worked on it. */
  work: number;
}

/** A face, relative to the person's neutral one. */
export interface Reading {
  /** Coefficients by the names of ARKit in lower case, about -1 to 1, and 0 at rest. */
  scores: Map<string, number>;
  /** Turn of the head, row-major. */
  turn: Float64Array;
  /** Motion of the head in metres: to the person's left, up, ahead. */
  shift: [number, number, number];
  /** When the picture came, on the page's clock. */
  milliseconds: number;
  /** How long the detector worked on it, in milliseconds. */
  work: number;
}

export type WebcamState = "off" | "opening" | "calibrating" | "running" | "no face";

/** Its message tells a person what to do. */
export class WebcamError extends Error {}

/** Length of the calibration in seconds, and the least number of pictures in it. */
const NEUTRAL_SECONDS = 1, NEUTRAL_PICTURES = 5;
/** Milliseconds without a face after which the state says so. */
const LOST_AFTER = 1000;
/** Largest motion of the head, in metres: it comes near, but does not exceed it. */
const MOST_SHIFT = 0.08;
const CENTIMETRE = 0.01;
const SCORES: Smoothing = { rest: 3, follow: 8 }, TURNS: Smoothing = { rest: 1.5, follow: 12 }, SHIFTS: Smoothing = { rest: 1, follow: 60 };

export class Webcam {
  /** The camera's picture, for a preview. */
  readonly video = document.createElement("video");
  /** Whether left and right are exchanged, as in a mirror. */
  mirrored = true;
  /** Called with each face. */
  onReading: (reading: Reading) => void = () => {};
  /** Called when the state changes. `why` is set when the camera has stopped by itself. */
  onState: (state: WebcamState, why?: string) => void = () => {};

  private current: WebcamState = "off";
  private worker: Worker | null = null;
  private opened: Promise<void> | null = null;
  private busy = false;
  private run = 0;
  private last = -1;
  private seen = 0;
  private neutral: Neutral | null = null;
  private gathered: { since: number; rows: Raw[] } | null = null;
  private filters = new Map<string, OneEuro>();
  private readonly hide = () => document.hidden && this.stop("The camera is off, because the page was hidden.");
  private readonly leave = () => this.stop();

  /** `parts` is called at the first start, so that a page loads nothing large before. */
  constructor(private readonly parts: () => DetectorParts | Promise<DetectorParts>) {
    this.video.muted = this.video.playsInline = true;
  }

  get state(): WebcamState {
    return this.current;
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
      await Promise.all([this.video.play(), (this.opened ??= this.open())]);
      if (run !== this.run) return;
    } catch (error) {
      if (run === this.run) this.stop();
      throw error instanceof WebcamError ? error : new WebcamError(`The camera cannot be used: ${(error as Error).message ?? error}`);
    }
    this.filters.clear();
    this.neutral = null;
    this.calibrate();
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
    this.gathered = { since: NaN, rows: [] };
    this.become("calibrating");
  }

  /** Drives an avatar, until the function that it returns is called. A motion that plays has precedence. */
  attach(viewer: Viewer, after: () => void = () => {}): () => void {
    const before = this.onReading;
    this.onReading = (reading) => {
      before(reading);
      if (viewer.playing) return;
      transfer(reading.scores, reading.turn, viewer.avatar, viewer.face, reading.shift);
      viewer.change();
      after();
    };
    return () => (this.onReading = before);
  }

  private become(state: WebcamState, why?: string): void {
    if (state === this.current && !why) return;
    this.current = state;
    this.onState(state, why);
  }

  /** Starts the worker. It stays for later starts. */
  private async open(): Promise<void> {
    try {
      const parts: Record<string, ArrayBuffer> = {};
      for (const [name, given] of Object.entries(await this.parts())) parts[name] = await bytes(given);
      const address = URL.createObjectURL(new Blob([DETECTOR], { type: "text/javascript" }));
      const worker = (this.worker = new Worker(address));
      await new Promise<void>((done, fail) => {
        worker.onerror = (event) => fail(new WebcamError(`The face detector does not start: ${event.message}`));
        worker.onmessage = ({ data }) => (data.ready ? done() : fail(new WebcamError(`The face detector does not start: ${data.error}`)));
        worker.postMessage({ parts }, Object.values(parts));
      });
      URL.revokeObjectURL(address);
      worker.onmessage = ({ data }) => {
        this.busy = false;
        if (data.error) return this.stop(`The face detector has failed: ${data.error}`);
        if (this.current !== "off" && this.current !== "opening") this.take(data);
      };
    } catch (error) {
      this.worker?.terminate();
      this.worker = this.opened = null;
      throw error;
    }
  }

  /** Sends each new picture to the worker. Pictures that come while it works are left out. */
  private watch(run: number): void {
    const { video } = this;
    let newest = 0, sent = 0;
    const send = async () => {
      if (this.run !== run) return;
      if (!this.busy && newest > sent) {
        this.busy = true;
        // MediaPipe wants times that increase.
        const milliseconds = (this.last = Math.max(newest, this.last + 1));
        sent = newest;
        try {
          const picture = await createImageBitmap(video);
          this.worker!.postMessage({ picture, milliseconds }, [picture]);
        } catch {
          this.busy = false; // the camera has just stopped
        }
      }
    };
    this.idle = send;
    const see = (now: number) => {
      if (this.run !== run) return;
      newest = now;
      send();
      video.requestVideoFrameCallback(see);
    };
    video.requestVideoFrameCallback(see);
  }

  private idle: () => void = () => {};

  private take(found: Found): void {
    this.idle();
    const { scores, matrix, milliseconds } = found;
    if (!scores || !matrix) {
      if (milliseconds - this.seen > LOST_AFTER) this.become("no face");
      return;
    }
    this.seen = milliseconds;
    const size = Math.hypot(matrix[0], matrix[1], matrix[2]) || 1;
    const m = (k: number) => matrix[k] / size;
    const raw: Raw = {
      scores: new Map(scores.map(([name, score]) => [name.toLowerCase(), score])),
      turn: axisAngle([m(0), m(4), m(8), m(1), m(5), m(9), m(2), m(6), m(10)]),
      place: [12, 13, 14].map((k) => CENTIMETRE * matrix[k]),
    };
    if (this.gathered) this.gather(raw, milliseconds / 1000);
    if (!this.neutral) return;
    if (!this.gathered) this.become("running");
    this.onReading(this.read(raw, this.neutral, found));
  }

  private gather(raw: Raw, seconds: number): void {
    const { since, rows } = this.gathered!;
    this.become("calibrating");
    if (Number.isNaN(since)) this.gathered!.since = seconds;
    rows.push(raw);
    if (seconds - since < NEUTRAL_SECONDS || Number.isNaN(since) || rows.length < NEUTRAL_PICTURES) return;
    this.gathered = null;
    const middle = (of: (row: Raw) => number) => rows.map(of).sort((a, b) => a - b)[rows.length >> 1];
    const turn = rotationMatrix([0, 1, 2].map((k) => middle((row) => row.turn[k])), 0);
    this.neutral = {
      scores: new Map([...raw.scores.keys()].map((name) => [name, middle((row) => row.scores.get(name) ?? 0)])),
      back: transposed(turn),
      place: [0, 1, 2].map((k) => middle((row) => row.place[k])),
    };
  }

  private read(raw: Raw, neutral: Neutral, { milliseconds, work }: Found): Reading {
    const seconds = milliseconds / 1000, side = this.mirrored ? -1 : 1;
    const smooth = (name: string, value: number, smoothing: Smoothing) => {
      let filter = this.filters.get(name);
      if (!filter) this.filters.set(name, (filter = new OneEuro(smoothing)));
      return filter.next(value, seconds);
    };
    const scores = new Map<string, number>();
    for (const [name, score] of raw.scores) {
      const rest = neutral.scores.get(name) ?? 0;
      // A full expression stays a full one.
      const value = score > rest ? (score - rest) / Math.max(1 - rest, 0.1) : score - rest;
      scores.set(this.mirrored ? otherSide(name) : name, smooth(name, value, SCORES));
    }
    const turned = axisAngle(multiplied(neutral.back, rotationMatrix(raw.turn, 0))).map((angle, k) => smooth(`turn${k}`, angle, TURNS));
    const from = raw.place.map((at, k) => at - neutral.place[k]);
    const inHead = [0, 1, 2].map((k) => neutral.back[3 * k] * from[0] + neutral.back[3 * k + 1] * from[1] + neutral.back[3 * k + 2] * from[2]);
    const [x, y, z] = inHead.map((value, k) => MOST_SHIFT * Math.tanh(smooth(`shift${k}`, value, SHIFTS) / MOST_SHIFT));
    return { scores, turn: rotationMatrix([turned[0], side * turned[1], side * turned[2]], 0), shift: [side * x, y, z], milliseconds, work };
  }
}

interface Raw {
  scores: Map<string, number>;
  turn: number[];
  place: number[];
}

interface Neutral {
  scores: Map<string, number>;
  back: Float64Array;
  place: number[];
}

/** mouthSmileLeft -> mouthSmileRight, in lower case. */
function otherSide(name: string): string {
  if (name.endsWith("left")) return name.slice(0, -4) + "right";
  return name.endsWith("right") ? name.slice(0, -5) + "left" : name;
}

const stop = (stream: MediaStream | null) => stream?.getTracks().forEach((track) => track.stop());

async function bytes(given: string | ArrayBuffer): Promise<ArrayBuffer> {
  if (typeof given !== "string") return given;
  const answer = await fetch(given);
  if (!answer.ok) throw new WebcamError(`${given} cannot be fetched: the server answers ${answer.status}.`);
  return answer.arrayBuffer();
}

/** Opens the camera that faces the user, or says why not in words that help. */
async function camera(): Promise<MediaStream> {
  if (!navigator.mediaDevices?.getUserMedia)
    throw new WebcamError(
      location.protocol === "file:"
        ? "This browser gives no camera to a page from a file. Open the file with Chrome, Edge or Firefox, or put it on a web server with https."
        : location.protocol === "http:"
          ? "Browsers give a camera only to pages with https. Open this page by its https address."
          : "This browser gives no camera to this page. Open it with another browser.",
    );
  try {
    return await navigator.mediaDevices.getUserMedia({ audio: false, video: { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 30 } } });
  } catch (error) {
    const { name, message } = error as DOMException;
    const words: Record<string, string> = {
      NotAllowedError: "The camera is not allowed. Allow it for this page (the camera sign beside the address), and press the button again. A page in a frame needs allow=\"camera\" there.",
      NotFoundError: "There is no camera. Connect one, and press the button again.",
      NotReadableError: "The camera does not answer. Close other programs that use it, and press the button again.",
    };
    const same: Record<string, string> = { SecurityError: "NotAllowedError", OverconstrainedError: "NotFoundError", DevicesNotFoundError: "NotFoundError", AbortError: "NotReadableError" };
    throw new WebcamError(words[same[name] ?? name] ?? `The camera cannot be used: ${message || name}`);
  }
}
