// A microphone as a driver: the lips of the avatar follow a voice (voice.ts). The sound stays in the page.

import type { Face } from "./avatar";
import type { Viewer } from "./viewer";
import { measured, Voice, type Mouth } from "./voice";

/** Samples of a moment of sound: 43 ms at 48 kHz. */
const SAMPLES = 2048;

/** What went wrong. Its message tells a person what to do. */
export class MicrophoneError extends Error {}

export class Microphone {
  /** Called when it starts and stops. `why` is set when it has stopped by itself. */
  onState: (on: boolean, why?: string) => void = () => {};
  /** Called with each moment, before it is drawn. */
  onMouth: (mouth: Mouth) => void = () => {};
  private run = 0;
  private stream: MediaStream | null = null;
  private context: AudioContext | null = null;
  private mouth: Mouth = {};
  private readonly hide = () => document.hidden && this.stop("The microphone is off, because the page was hidden.");

  constructor(private readonly viewer: Viewer) {
    const { alive, avatar } = viewer, { expression_names: names, expression_bounds: bounds, neutral } = avatar;
    viewer.alive = (face: Face) => {
      alive?.(face);
      // A smile stays while one speaks.
      for (const [name, value] of Object.entries(this.mouth)) {
        const e = names.indexOf(name);
        if (e >= 0) face.expression[e] = Math.max(face.expression[e], Math.min(neutral.expression[e] + value, bounds[2 * e + 1]));
      }
    };
  }

  get on(): boolean {
    return this.stream !== null;
  }

  /**
   * Asks for the microphone, and starts.
   * @throws MicrophoneError if there is none, or it may not be used.
   */
  async start(): Promise<void> {
    const run = ++this.run, stream = await opened();
    if (run !== this.run) return end(stream);
    this.stop();
    const context = (this.context = new AudioContext()), analyser = context.createAnalyser(), voice = new Voice();
    this.stream = stream;
    stream.getAudioTracks()[0].addEventListener("ended", () => this.stop("The microphone was taken away or switched off."));
    document.addEventListener("visibilitychange", this.hide);
    analyser.fftSize = SAMPLES;
    analyser.smoothingTimeConstant = 0;
    context.createMediaStreamSource(stream).connect(analyser);
    void context.resume();
    const listen = () => {
      if (this.stream !== stream) return;
      if (context.currentTime > 0) this.onMouth((this.mouth = voice.next(...measured(analyser), context.currentTime)));
      this.viewer.change();
      requestAnimationFrame(listen);
    };
    listen();
    this.onState(true);
  }

  /** Switches the microphone off, and shuts the mouth. */
  stop(why?: string): void {
    if (!this.stream) return;
    ++this.run;
    end(this.stream);
    void this.context!.close();
    this.stream = this.context = null;
    this.mouth = {};
    document.removeEventListener("visibilitychange", this.hide);
    this.viewer.change();
    this.onState(false, why);
  }
}

const end = (stream: MediaStream) => stream.getTracks().forEach((track) => track.stop());

/** Opens the microphone, or says why not in words that help. */
async function opened(): Promise<MediaStream> {
  if (!navigator.mediaDevices?.getUserMedia)
    throw new MicrophoneError("This browser gives no microphone to this page. Open the file with Chrome or Edge, or put it on a web server with https.");
  try {
    return await navigator.mediaDevices.getUserMedia({ audio: { echoCancellation: false, autoGainControl: false, noiseSuppression: true } });
  } catch (error) {
    const { name, message } = error as DOMException;
    const words: Record<string, string> = {
      NotAllowedError: "The microphone is not allowed. Allow it for this page (the sign beside the address), and press the button again.",
      NotFoundError: "There is no microphone. Connect one, and press the button again.",
      NotReadableError: "The microphone does not answer. Close other programs that use it, and press the button again.",
    };
    throw new MicrophoneError(words[name] ?? `The microphone cannot be used: ${message || name}`);
  }
}
