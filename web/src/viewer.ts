// An avatar on a canvas: face, camera, a packed motion, and drawing when something has changed.

import { copyFace, motionFace, motionLength, type Avatar, type Face, type Motion } from "./avatar";
import { setNamed } from "./named";
import { Renderer, type Backend, type Color, type Drawer, type View } from "./renderer";
import { Poser } from "./rig";
import { chained, moved, rigid, rotationMatrix } from "./rigid";
import { standStill } from "./torso";
import { DepthSorter } from "./sort";

/** Turns beyond this would show the head upside down, in radians. */
const MOST_PITCH = 1.4;
/** Half of a head's width and depth, with room for hair and for a head that moves. */
const HAIR = 0.65;

/** A camera of another 3D program: column-major matrices as OpenGL has them. */
export interface Matrices {
  /** From the camera to the screen. */
  projection: ArrayLike<number>;
  /** From the head frame (+x to the person's left, +y up, +z out of the face, metres) to the camera. */
  headToCamera: ArrayLike<number>;
}

export class Viewer {
  /** The face that is drawn. After changing it, call `change`. */
  readonly face: Face;
  /** The face of the last picture: `face`, with the signs of life that `alive` added. */
  shown: Face;
  /** Turn of the camera about the head, in radians, and its zoom. */
  yaw = 0;
  pitch = 0;
  zoom = 1;
  /** The camera of another 3D program, in place of the viewer's own. */
  matrices: Matrices | null = null;
  /** Colour behind the head; alpha 0 is transparent. */
  background: Color = [0, 0, 0, 0];
  /** Timestep of the motion, and whether it runs. */
  timestep = 0;
  playing = false;
  /** Whether the motion begins again at its end. */
  loop = true;
  /** Changes a copy of the face before it is drawn, while no motion plays: signs of life (`enliven`). */
  alive: ((face: Face) => void) | null = null;
  /** Called after each timestep of the motion, so that a page can move its sliders. */
  onMotion: () => void = () => {};
  /** Time to pose, sort and hand over the last picture, in milliseconds. */
  milliseconds = 0;

  private readonly poser: Poser;
  private readonly sorter: DepthSorter;
  private readonly depths: Float32Array;
  private readonly middle: number[];
  private readonly radius: number;
  private renderer: Drawer;
  /** Coefficients of the gaze that `setExpression` set. */
  private readonly gaze = new Map<string, number>();
  private posed = false;
  private waiting = 0;
  private stale = true;
  private before = 0;
  private since = 0;

  constructor(readonly canvas: HTMLCanvasElement, readonly avatar: Avatar, public motion: Motion | null = null, backend?: Backend) {
    this.face = copyFace(avatar.neutral);
    this.shown = this.face;
    this.poser = new Poser(avatar.baked);
    const count = this.poser.faceIndex.length;
    this.sorter = new DepthSorter(count);
    this.depths = new Float32Array(count);
    [this.middle, this.radius] = middleOf(this.poser.rest);
    this.renderer = backend?.(canvas, avatar, this.poser, () => this.change(), Renderer) ?? new Renderer(canvas, avatar, this.poser);
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.renderer = new Renderer(canvas, avatar, this.poser);
      this.change();
    });
  }

  /**
   * Sets an expression, a gaze (eyeLookUpLeft, ...) or a whole face (smile, ...) by name, within its range. A whole face
   * changes its expressions relative to the person at rest, and leaves the others. False if the name does nothing.
   */
  setExpression(name: string, value: number): boolean {
    const works = setNamed(this.avatar, this.face, this.gaze, name, value);
    if (works) this.change();
    return works;
  }

  /** Goes back to the person at rest, seen by the first camera. */
  reset(): void {
    this.take(this.avatar.neutral);
    this.yaw = this.pitch = 0;
    this.zoom = 1;
  }

  /** Shows a face. */
  take(face: Face): void {
    this.gaze.clear();
    for (const part of ["expression", "joints", "head_rotation", "head_translation"] as const) this.face[part].set(face[part]);
    this.change();
  }

  /** Shows a timestep of the motion. */
  seek(timestep: number): void {
    if (!this.motion) return;
    this.timestep = timestep;
    this.take(motionFace(this.motion, timestep));
    this.onMotion();
  }

  /** Takes another motion, and shows its first timestep. */
  setMotion(motion: Motion | null): void {
    this.motion = motion;
    this.play(false);
    this.seek(0);
  }

  play(playing = true): void {
    this.playing = playing && this.motion !== null;
    this.before = this.since = 0;
    if (this.playing) this.seek(this.timestep);
  }

  /** Draws soon, because the face has changed. */
  change(): void {
    this.posed = false;
    this.shown = this.face;
    this.look();
  }

  /** Draws soon, because the camera, the background or the size has changed. */
  look(): void {
    this.pitch = Math.min(Math.max(this.pitch, -MOST_PITCH), MOST_PITCH);
    this.zoom = Math.min(Math.max(this.zoom, 0.2), 8);
    this.stale = true;
    this.wait();
  }

  /** The view for a picture of that size: the whole first camera's picture fits into it, and into a narrow one the head. */
  view(width: number, height: number): View {
    const { K, viewmat, width: w, height: h } = this.avatar.camera;
    const pose = rigid(rotationMatrix(this.shown.head_rotation, 0), this.shown.head_translation);
    const { head_rotation, head_translation } = this.avatar.neutral;
    const rest = rigid(rotationMatrix(head_rotation, 0), head_translation);
    // The camera turns about the middle of the head at rest, seen from where the first camera stands.
    const pivot = moved(viewmat, moved(rest, this.middle));
    const reach = Math.abs((K[0] * pivot[0]) / pivot[2] + K[2] - w / 2) + (K[0] * this.radius) / pivot[2];
    const scale = Math.min(width / Math.min(w, 2 * reach), height / h);
    const turn = chained(rigid(rotationMatrix([this.pitch, 0, 0], 0), [0, 0, 0]), rigid(rotationMatrix([0, this.yaw, 0], 0), [0, 0, 0]));
    const to = moved(turn, pivot);
    turn[3] = pivot[0] - to[0];
    turn[7] = pivot[1] - to[1];
    turn[11] = pivot[2] - to[2];
    const worldDirections = this.poser.bound?.sh_frame === "world";
    const p = pose;
    const directions = worldDirections ? [p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]] : [1, 0, 0, 0, 1, 0, 0, 0, 1];
    if (this.matrices) return { directions, width, height, ...fromOpenGL(this.matrices, width, height) };
    return {
      head: chained(turn, chained(viewmat, pose)),
      directions,
      focal: [K[0] * scale * this.zoom, K[4] * scale * this.zoom],
      centre: [width / 2 + (K[2] - w / 2) * scale * this.zoom, height / 2 + (K[5] - h / 2) * scale * this.zoom],
      width,
      height,
    };
  }

  /** Draws now, at the canvas's size. */
  draw(): void {
    const began = performance.now(), { width, height } = this.canvas;
    this.stale = false;
    if (!this.posed) {
      this.shown = copyFace(this.face);
      if (this.alive && !this.playing) this.alive(this.shown);
      standStill(this.shown, this.avatar);
      this.poser.pose(this.shown);
      this.renderer.upload();
      this.posed = true;
    }
    const view = this.view(width, height);
    const order = () => {
      this.poser.depths(Array.prototype.slice.call(view.head, 8, 12), this.depths);
      return this.sorter.sort(this.depths);
    };
    this.renderer.draw(order, view, this.background);
    this.milliseconds = performance.now() - began;
  }

  /** Frees what the avatar holds on the GPU. Nothing is drawn after it. */
  dispose(): void {
    this.playing = this.stale = false;
    cancelAnimationFrame(this.waiting);
    this.renderer.dispose();
  }

  private wait(): void {
    if (!this.waiting) this.waiting = requestAnimationFrame((now) => this.tick(now));
  }

  private tick(now: number): void {
    this.waiting = 0;
    if (this.playing && this.motion) {
      const period = 1000 / this.motion.fps;
      this.since += this.before ? Math.min(now - this.before, 1000) : 0;
      this.before = now;
      const steps = Math.floor(this.since / period);
      this.since -= steps * period;
      const next = this.timestep + steps, length = motionLength(this.motion);
      if (!this.loop && next >= length) {
        this.play(false);
        this.onMotion();
      } else if (steps) this.seek(next % length);
      if (this.playing) this.wait();
    }
    if (this.stale) this.draw();
  }
}

/** The same camera with axes that go right, down and forward, as rows of [R | t], and its focal lengths in pixels. */
function fromOpenGL({ projection: p, headToCamera: m }: Matrices, width: number, height: number): Pick<View, "head" | "focal" | "centre"> {
  const row = (sign: number, k: number) => [m[k], m[4 + k], m[8 + k], m[12 + k]].map((x) => sign * x);
  return {
    head: [...row(1, 0), ...row(-1, 1), ...row(-1, 2)],
    focal: [(p[0] * width) / 2, (p[5] * height) / 2],
    centre: [((1 - p[8]) * width) / 2, ((1 + p[9]) * height) / 2],
  };
}

/** The middle of the box around points, and how far to the sides it reaches when it turns, with hair. */
function middleOf(points: Float32Array): [number[], number] {
  let radius = 0;
  const middle = [0, 1, 2].map((axis) => {
    let least = Infinity, most = -Infinity;
    for (let i = axis; i < points.length; i += 3) {
      least = Math.min(least, points[i]);
      most = Math.max(most, points[i]);
    }
    if (axis !== 1) radius = Math.max(radius, HAIR * (most - least));
    return (least + most) / 2;
  });
  return [middle, radius];
}
