// Films with the camera: shows it as a mirror, guides, and sends the recording while it grows.

import { Detector } from "../detector";
import { camera } from "../webcam";
import { ask, person, Sending } from "./api";
import { Guide } from "./guide";
import { lightOf } from "./light";

/** The recording's formats, in the order of preference, with the endings of their files. */
const FORMATS = [["video/webm;codecs=h264", "webm"], ["video/webm;codecs=vp8", "webm"], ["video/webm", "webm"], ["video/mp4", "mp4"]];
/** Bits of a second of the recording: fine detail is what avatars are made of. */
const BITS = 16_000_000;
const FACE = 256;
/** Longest side in pixels of what the detector sees. */
const SEEN = 720;

export const PARTS = { vision: "/landmarker/vision", loader: "/landmarker/loader", wasm: "/landmarker/wasm", model: "/landmarker/model" };
const detector = new Detector(() => PARTS, 2);

/** A picture of a face for the list, as JPEG. */
export async function portrait(video: HTMLVideoElement, [x0, y0, x1, y1]: number[]): Promise<Blob> {
  const { videoWidth: w, videoHeight: h } = video, side = Math.min(1.6 * (y1 - y0) * h, w, h);
  const left = Math.min(Math.max(((x0 + x1) / 2) * w - side / 2, 0), w - side), top = Math.min(Math.max(((y0 + y1) / 2) * h - 0.53 * side, 0), h - side);
  const canvas = new OffscreenCanvas(FACE, FACE);
  canvas.getContext("2d")!.drawImage(video, left, top, side, side, 0, 0, FACE, FACE);
  return canvas.convertToBlob({ type: "image/jpeg", quality: 0.88 });
}

export class Filming {
  guide = new Guide();
  /** Called after each picture that was looked at. */
  onSeen: () => void = () => {};
  /** Called when the camera or the sending has failed. What was sent stays. */
  onEnd: (why: string) => void = () => {};

  private stream: MediaStream | null = null;
  private recorder: MediaRecorder | null = null;
  /** The name of the film that is recorded. */
  film = "";
  private sending: Sending | null = null;
  private running = false;
  private wantsFace = false;
  /** A picture for the list, which is kept with the film. */
  private face: Blob | null = null;

  constructor(private readonly name: string, private readonly video: HTMLVideoElement) {}

  get recording(): boolean {
    return this.recorder?.state === "recording";
  }

  /** Bytes of the film that are on the disk. */
  get sent(): number {
    return this.sending?.sent ?? 0;
  }

  /** Opens the camera at its best, and begins to look. */
  async open(): Promise<void> {
    const stream = (this.stream = await camera({ width: { ideal: 1920 }, height: { ideal: 1080 } }));
    stream.getVideoTracks()[0].addEventListener("ended", () => this.fail("The camera was unplugged or switched off. What was filmed until then is kept."));
    this.video.srcObject = stream;
    await Promise.all([this.video.play(), detector.open()]);
    this.running = true;
    detector.onFound = (found) => {
      if (!this.running) return;
      if (this.recording && this.wantsFace && found.box) {
        this.wantsFace = false;
        void portrait(this.video, found.box).then((face) => (this.face = face));
      }
      this.guide.see(found, found.box ? lightOf(this.video, found.box) : null);
      this.onSeen();
    };
    detector.onError = (why) => this.fail(why);
    const watch = (now: number) => {
      if (!this.running) return;
      look(this.video, now);
      requestAnimationFrame(watch);
    };
    requestAnimationFrame(watch);
  }

  /** Begins to record. The guide begins anew, with the face of this moment as the neutral one. */
  async record(withFace: boolean): Promise<void> {
    const [type, ending] = FORMATS.find(([each]) => MediaRecorder.isTypeSupported(each)) ?? [];
    if (!type) throw new Error("This browser records no films. Choose a file, or open the studio in Chrome, Edge, Firefox or Safari.");
    [this.sending, this.film] = await Sending.begin(this.name, ending);
    this.wantsFace = withFace;
    const recorder = (this.recorder = new MediaRecorder(this.stream!, { mimeType: type, videoBitsPerSecond: BITS }));
    recorder.ondataavailable = ({ data }) => this.sending!.send(data).catch((error) => this.fail(error.message));
    this.guide = new Guide();
    recorder.start(1000);
  }

  /** Ends the film, and returns its name; null if nothing was recorded. What is not kept is removed. */
  async finish(keeps = true): Promise<string | null> {
    const { recorder, film } = this;
    if (!recorder) return null;
    if (recorder.state !== "inactive") {
      const ended = new Promise((done) => recorder.addEventListener("stop", done, { once: true }));
      recorder.stop();
      await ended;
    }
    await this.sending!.send(new Blob());
    this.recorder = null;
    await (keeps ? ask("POST", person(this.name, "films", film), {}) : ask("DELETE", person(this.name, "films", film)));
    if (keeps && this.face) await ask("PUT", person(this.name, "face"), this.face).catch(() => {});
    return keeps ? film : null;
  }

  /** Switches the camera off. */
  close(): void {
    this.running = false;
    this.stream?.getTracks().forEach((track) => track.stop());
    this.stream = this.video.srcObject = null;
  }

  private fail(why: string): void {
    if (!this.running) return;
    this.close();
    this.onEnd(why);
  }
}

/** Lets the detector see the picture of this moment, which needs no more pixels than that. */
function look(video: HTMLVideoElement, now: number): void {
  const { videoWidth: w, videoHeight: h } = video, scale = Math.min(1, SEEN / Math.max(w, h));
  void detector.see(() => createImageBitmap(video, { resizeWidth: Math.round(w * scale), resizeHeight: Math.round(h * scale) }), now);
}

/** How many pictures of a film are looked at in a second of it. */
const LOOKS = 3;

/** Looks through a film by the rules of the guide. Returns what would make it better, and a picture of the face. */
export async function check(source: string, moved: (share: number) => void): Promise<{ missing: string[]; face: Blob | null }> {
  const video = document.createElement("video"), guide = new Guide();
  video.muted = video.playsInline = true;
  video.src = source;
  await new Promise((done, fail) => {
    video.onloadeddata = done;
    video.onerror = () => fail(new Error("This browser cannot play the film, so it is not checked. mien may read it all the same."));
  });
  await detector.open();
  // A recording says how long it is only after a look at its end.
  if (!Number.isFinite(video.duration)) await seek(video, 1e7);
  const length = Math.min(Number.isFinite(video.duration) ? video.duration : video.currentTime, 120);
  let face: Blob | null = null;
  for (let time = 0; time < length; time += 1 / LOOKS) {
    await seek(video, time);
    const found = await new Promise<Parameters<typeof detector.onFound>[0]>((done, fail) => {
      detector.onFound = done;
      detector.onError = (why) => fail(new Error(why));
      look(video, performance.now());
    });
    guide.see({ ...found, milliseconds: 1000 * time }, found.box ? lightOf(video, found.box) : null);
    if (!face && found.box && time >= 1) face = await portrait(video, found.box);
    moved(time / length);
  }
  video.removeAttribute("src");
  return { missing: guide.missing(), face };
}

const seek = (video: HTMLVideoElement, time: number) =>
  new Promise<void>((done) => {
    video.onseeked = () => done();
    video.currentTime = time;
  });
