// MediaPipe's face landmarker in a worker (webcam_detector.ts): opens it, and hands it one picture at a time.

import type { Found } from "./follower";

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

/** What went wrong. Its message tells a person what to do. */
export class WebcamError extends Error {}

export class Detector {
  onFound: (found: Found) => void = () => {};
  onError: (why: string) => void = () => {};
  /** Whether it works on a picture. */
  busy = false;
  private worker: Worker | null = null;
  private opened: Promise<void> | null = null;
  private last = -1;

  /** `parts` is called at the first opening. `faces` is the largest number of faces that are looked for. */
  constructor(private readonly parts: () => DetectorParts | Promise<DetectorParts>, private readonly faces = 1) {}

  /** Starts the worker. It stays for later pictures. */
  open(): Promise<void> {
    return (this.opened ??= this.start());
  }

  /** Hands over a picture, unless it works on one. Times may be any; MediaPipe wants them to increase. */
  async see(take: () => Promise<ImageBitmap>, time: number): Promise<void> {
    if (this.busy) return;
    this.busy = true;
    const milliseconds = (this.last = Math.max(time, this.last + 1));
    try {
      const picture = await take();
      this.worker!.postMessage({ picture, milliseconds }, [picture]);
    } catch {
      this.busy = false; // the camera has just stopped
    }
  }

  private async start(): Promise<void> {
    try {
      const parts: Record<string, ArrayBuffer> = {};
      for (const [name, given] of Object.entries(await this.parts())) parts[name] = await bytes(given);
      const address = URL.createObjectURL(new Blob([DETECTOR], { type: "text/javascript" }));
      const worker = (this.worker = new Worker(address));
      await new Promise<void>((done, fail) => {
        worker.onerror = (event) => fail(new WebcamError(`The face detector does not start: ${event.message}`));
        worker.onmessage = ({ data }) => (data.ready ? done() : fail(new WebcamError(`The face detector does not start: ${data.error}`)));
        worker.postMessage({ parts, faces: this.faces }, Object.values(parts));
      });
      URL.revokeObjectURL(address);
      worker.onerror = (event) => this.onError(`The face detector has failed: ${event.message}`);
      worker.onmessage = ({ data }) => {
        this.busy = false;
        if (data.error) return this.onError(`The face detector has failed: ${data.error}`);
        this.onFound(data);
      };
    } catch (error) {
      this.worker?.terminate();
      this.worker = this.opened = null;
      throw error;
    }
  }
}

async function bytes(given: string | ArrayBuffer): Promise<ArrayBuffer> {
  if (typeof given !== "string") return given;
  const answer = await fetch(given);
  if (!answer.ok) throw new WebcamError(`${given} cannot be fetched: the server answers ${answer.status}.`);
  return answer.arrayBuffer();
}
