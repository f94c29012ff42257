// Posed Gaussians as arrays, for engines that draw them among other objects: mien-web/three, spark, playcanvas and babylon.

import { copyFace, motionFace, motionLength, Poser, setNamed, type Avatar, type Face, type Motion } from "./index";
import { SimdPosing } from "./simd";
import { chained, moved, rigid, rotationMatrix, transposed } from "./rigid";
import { standStill } from "./torso";

const SH_C0 = 0.28209479177387814;
const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** Arrays that a pose fills, each with a row for each Gaussian. The caller owns them, and leaves out what it does not need. */
export interface Gaussians {
  /** [n, 3], in metres. */
  centres?: Float32Array;
  /** [n, 4], quaternions x y z w of unit length. */
  rotations?: Float32Array;
  /** [n, 3], standard deviations in metres. */
  scales?: Float32Array;
  /** [n, 6]: xx, xy, xz, yy, yz, zz, in square metres: what rotations and scales say, in another form. */
  covariances?: Float32Array;
  /** [n, 4]: red, green, blue as a screen shows them (sRGB), 0 or more, then the opacity, 0 to 1. */
  colors?: Float32Array;
}

/** Where Gaussians go, and from where they are seen. */
export interface Place {
  /** Row of the first Gaussian. */
  first?: number;
  /** From the head to the scene: 16 numbers, column by column, without shear. Null leaves Gaussians in the head frame. */
  transform?: ArrayLike<number> | null;
  /** The camera's place in the scene, for colours that depend on the view. */
  eye?: ArrayLike<number> | null;
}

/** Writes the quaternion x y z w of the rotation in the rows of a transform with scale `k`, at `at`. */
function writeQuaternion(m: ArrayLike<number>, o: number, k: number, out: Float32Array, at: number): void {
  const xx = m[o] / k, yy = m[o + 5] / k, zz = m[o + 10] / k;
  const x = (m[o + 9] - m[o + 6]) / k, y = (m[o + 2] - m[o + 8]) / k, z = (m[o + 4] - m[o + 1]) / k;
  const xy = (m[o + 1] + m[o + 4]) / k, xz = (m[o + 2] + m[o + 8]) / k, yz = (m[o + 6] + m[o + 9]) / k;
  let a = x, b = y, c = z, d = 1 + xx + yy + zz;
  if (d < 1) {
    if (xx >= yy && xx >= zz) [a, b, c, d] = [1 + xx - yy - zz, xy, xz, x];
    else if (yy >= zz) [a, b, c, d] = [xy, 1 - xx + yy - zz, yz, y];
    else [a, b, c, d] = [xz, yz, 1 - xx - yy + zz, z];
  }
  const length = Math.sqrt(a * a + b * b + c * c + d * d);
  out[at] = a / length;
  out[at + 1] = b / length;
  out[at + 2] = c / length;
  out[at + 3] = d / length;
}

/** Values of the 15 spherical harmonics after the first in a direction of unit length. */
function harmonics(x: number, y: number, z: number, out: Float64Array): void {
  const xx = x * x, yy = y * y, zz = z * z;
  out[0] = -0.4886025119029199 * y;
  out[1] = 0.4886025119029199 * z;
  out[2] = -0.4886025119029199 * x;
  out[3] = 1.0925484305920792 * x * y;
  out[4] = -1.0925484305920792 * y * z;
  out[5] = 0.31539156525252005 * (2 * zz - xx - yy);
  out[6] = -1.0925484305920792 * x * z;
  out[7] = 0.5462742152960396 * (xx - yy);
  out[8] = -0.5900435899266435 * y * (3 * xx - yy);
  out[9] = 2.890611442640554 * x * y * z;
  out[10] = -0.4570457994644658 * y * (4 * zz - xx - yy);
  out[11] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
  out[12] = -0.4570457994644658 * x * (4 * zz - xx - yy);
  out[13] = 1.445305721320277 * z * (xx - yy);
  out[14] = -0.5900435899266435 * x * (xx - 3 * yy);
}

/** Poses an avatar into arrays. */
export class GaussianSource {
  /** The number of Gaussians. */
  readonly count: number;
  /** Whether colours depend on the view, so that they change with the camera. */
  readonly viewDependent: boolean;
  private readonly poser: Poser;
  /** Triangles that have Gaussians. */
  private readonly used: Int32Array;
  /** Rows of [k R | T] of each triangle, in the scene; their rotations and scales. */
  private readonly frames: Float32Array;
  private readonly turns: Float32Array;
  private readonly sizes: Float32Array;
  /** Shapes in the frames of triangles: rotations x y z w, standard deviations, covariances. */
  private readonly quats: Float32Array;
  private readonly scales: Float32Array;
  private readonly shapes: Float32Array;
  private readonly colors: Float32Array;
  private colored = false;
  /** What poses bound Gaussians; null where it cannot. */
  private readonly simd: SimdPosing | null;

  /** `simd` may be false for posing without WebAssembly, which is slower. */
  constructor(readonly avatar: Avatar, simd = true) {
    const { attributes } = avatar.baked, poser = (this.poser = new Poser(avatar.baked)), n = (this.count = attributes.opacity_logits.length);
    this.viewDependent = attributes.sh.length > 3 * n;
    this.used = Int32Array.from(new Set(poser.faceIndex));
    this.frames = new Float32Array(poser.frames.length);
    this.turns = new Float32Array(poser.frames.length / 3);
    this.sizes = new Float32Array(poser.frames.length / 12);
    [this.quats, this.scales, this.shapes, this.colors] = [4, 3, 6, 4].map((width) => new Float32Array(width * n));
    this.shape(attributes.quats, attributes.log_scales.map(Math.exp));
    this.simd = simd ? SimdPosing.on(poser, { quats: this.quats, scales: this.scales, covariances: this.shapes }, this.least) : null;
    if (this.simd) poser.binds = false;
  }

  /** The smallest value of a colour, before the view is known. */
  private get least(): number {
    return this.viewDependent ? -Infinity : 0;
  }

  /** Fills the arrays with the Gaussians of a face. */
  pose(face: Face, into: Gaussians, { first = 0, transform, eye }: Place = {}): void {
    const { poser, simd } = this, { free } = poser;
    poser.pose(face);
    if (simd) {
      simd.pose(poser, transform ?? IDENTITY, (name) => !!into[name]);
      for (const [name, values] of Object.entries(simd.results)) into[name as keyof Gaussians]?.set(values, (first * values.length) / this.count);
    } else {
      if (free) this.shape(free.quats, free.scales);
      if (poser.changed || !this.colored) this.color();
      this.place(transform);
      if (into.centres) this.writeCentres(into.centres, 3 * first);
      if (into.covariances) this.writeCovariances(into.covariances, 6 * first);
      if (into.rotations) this.writeRotations(into.rotations, 4 * first);
      if (into.scales) this.writeScales(into.scales, 3 * first);
      into.colors?.set(this.colors, 4 * first);
    }
    if (into.colors && this.viewDependent) this.addView(face, into.colors, 4 * first, eye, transform);
  }

  /** Takes rotations w x y z of any length, and standard deviations. */
  private shape(quats: Float32Array, scales: Float32Array): void {
    const { shapes } = this, R = new Float64Array(9);
    this.scales.set(scales);
    for (let i = 0, q = 0, s = 0, c = 0; i < this.count; ++i, q += 4, s += 3, c += 6) {
      const length = Math.sqrt(quats[q] ** 2 + quats[q + 1] ** 2 + quats[q + 2] ** 2 + quats[q + 3] ** 2) || 1;
      const w = quats[q] / length, x = quats[q + 1] / length, y = quats[q + 2] / length, z = quats[q + 3] / length;
      this.quats.set([x, y, z, w], q);
      R[0] = 1 - 2 * (y * y + z * z); R[1] = 2 * (x * y - w * z); R[2] = 2 * (x * z + w * y);
      R[3] = 2 * (x * y + w * z); R[4] = 1 - 2 * (x * x + z * z); R[5] = 2 * (y * z - w * x);
      R[6] = 2 * (x * z - w * y); R[7] = 2 * (y * z + w * x); R[8] = 1 - 2 * (x * x + y * y);
      const a = scales[s] ** 2, b = scales[s + 1] ** 2, d = scales[s + 2] ** 2;
      for (let row = 0, k = c; row < 3; ++row)
        for (let column = row; column < 3; ++column, ++k)
          shapes[k] = a * R[3 * row] * R[3 * column] + b * R[3 * row + 1] * R[3 * column + 1] + d * R[3 * row + 2] * R[3 * column + 2];
    }
  }

  private color(): void {
    const { colors, poser, count, least } = this, { colors: first, opacityLogits } = poser;
    for (let i = 0, c = 0, o = 0; i < count; ++i, c += 3, o += 4) {
      colors[o] = Math.max(0.5 + SH_C0 * first[c], least);
      colors[o + 1] = Math.max(0.5 + SH_C0 * first[c + 1], least);
      colors[o + 2] = Math.max(0.5 + SH_C0 * first[c + 2], least);
      colors[o + 3] = 1 / (1 + Math.exp(-opacityLogits[i]));
    }
    this.colored = true;
  }

  /** Takes the frames of triangles into the scene. */
  private place(transform?: ArrayLike<number> | null): void {
    const { frames, used } = this, from = this.poser.frames, m = transform;
    if (!m) {
      frames.set(from);
      return;
    }
    for (let u = 0; u < used.length; ++u) {
      const f = 12 * used[u];
      for (let column = 0; column < 4; ++column) {
        const x = from[f + column], y = from[f + 4 + column], z = from[f + 8 + column], w = column === 3 ? 1 : 0;
        frames[f + column] = m[0] * x + m[4] * y + m[8] * z + m[12] * w;
        frames[f + 4 + column] = m[1] * x + m[5] * y + m[9] * z + m[13] * w;
        frames[f + 8 + column] = m[2] * x + m[6] * y + m[10] * z + m[14] * w;
      }
    }
  }

  private writeCentres(out: Float32Array, to: number): void {
    const { frames, count } = this, { means, faceIndex } = this.poser;
    for (let i = 0, p = 0, o = to; i < count; ++i, p += 3, o += 3) {
      const f = 12 * faceIndex[i], x = means[p], y = means[p + 1], z = means[p + 2];
      out[o] = frames[f] * x + frames[f + 1] * y + frames[f + 2] * z + frames[f + 3];
      out[o + 1] = frames[f + 4] * x + frames[f + 5] * y + frames[f + 6] * z + frames[f + 7];
      out[o + 2] = frames[f + 8] * x + frames[f + 9] * y + frames[f + 10] * z + frames[f + 11];
    }
  }

  private writeCovariances(out: Float32Array, to: number): void {
    const { frames, shapes, count } = this, { faceIndex } = this.poser;
    for (let i = 0, c = 0, o = to; i < count; ++i, c += 6, o += 6) {
      const f = 12 * faceIndex[i];
      const a0 = frames[f], a1 = frames[f + 1], a2 = frames[f + 2], b0 = frames[f + 4], b1 = frames[f + 5], b2 = frames[f + 6];
      const c0 = frames[f + 8], c1 = frames[f + 9], c2 = frames[f + 10];
      const xx = shapes[c], xy = shapes[c + 1], xz = shapes[c + 2], yy = shapes[c + 3], yz = shapes[c + 4], zz = shapes[c + 5];
      const ax = a0 * xx + a1 * xy + a2 * xz, ay = a0 * xy + a1 * yy + a2 * yz, az = a0 * xz + a1 * yz + a2 * zz;
      const bx = b0 * xx + b1 * xy + b2 * xz, by = b0 * xy + b1 * yy + b2 * yz, bz = b0 * xz + b1 * yz + b2 * zz;
      const cx = c0 * xx + c1 * xy + c2 * xz, cy = c0 * xy + c1 * yy + c2 * yz, cz = c0 * xz + c1 * yz + c2 * zz;
      out[o] = ax * a0 + ay * a1 + az * a2;
      out[o + 1] = ax * b0 + ay * b1 + az * b2;
      out[o + 2] = ax * c0 + ay * c1 + az * c2;
      out[o + 3] = bx * b0 + by * b1 + bz * b2;
      out[o + 4] = bx * c0 + by * c1 + bz * c2;
      out[o + 5] = cx * c0 + cy * c1 + cz * c2;
    }
  }

  private writeRotations(out: Float32Array, to: number): void {
    const { frames, turns, quats, used, count } = this, { faceIndex } = this.poser;
    for (let u = 0; u < used.length; ++u) writeQuaternion(frames, 12 * used[u], this.sizeOf(used[u]), turns, 4 * used[u]);
    for (let i = 0, q = 0, o = to; i < count; ++i, q += 4, o += 4) {
      const t = 4 * faceIndex[i], a = turns[t], b = turns[t + 1], c = turns[t + 2], d = turns[t + 3];
      const x = quats[q], y = quats[q + 1], z = quats[q + 2], w = quats[q + 3];
      out[o] = d * x + a * w + b * z - c * y;
      out[o + 1] = d * y - a * z + b * w + c * x;
      out[o + 2] = d * z + a * y - b * x + c * w;
      out[o + 3] = d * w - a * x - b * y - c * z;
    }
  }

  private writeScales(out: Float32Array, to: number): void {
    const { scales, sizes, used, count } = this, { faceIndex } = this.poser;
    for (let u = 0; u < used.length; ++u) sizes[used[u]] = this.sizeOf(used[u]);
    for (let i = 0, s = 0, o = to; i < count; ++i, s += 3, o += 3) {
      const k = sizes[faceIndex[i]];
      out[o] = k * scales[s];
      out[o + 1] = k * scales[s + 1];
      out[o + 2] = k * scales[s + 2];
    }
  }

  /** The scale of a triangle's frame in the scene. */
  private sizeOf(triangle: number): number {
    const { frames } = this, f = 12 * triangle;
    return Math.sqrt(frames[f] ** 2 + frames[f + 4] ** 2 + frames[f + 8] ** 2);
  }

  /** Adds what the view changes to colours. Without an eye, they are left as they are from no side. */
  private addView(face: Face, out: Float32Array, to: number, eye?: ArrayLike<number> | null, transform?: ArrayLike<number> | null): void {
    const { count, simd } = this, { bound } = this.poser, { sh } = this.avatar.baked.attributes, values = new Float64Array(15);
    const m = transform ?? IDENTITY, rest = sh.length / 3 / count - 1, R = bound?.sh_frame === "world" ? rotationMatrix(face.head_rotation, 0) : [1, 0, 0, 0, 1, 0, 0, 0, 1];
    const centres = simd ? simd.results.centres : new Float32Array(3 * count);
    if (!simd) this.writeCentres(centres, 0);
    for (let i = 0, p = 0, o = to; i < count; ++i, p += 3, o += 4) {
      if (eye) {
        const x = centres[p] - eye[0], y = centres[p + 1] - eye[1], z = centres[p + 2] - eye[2];
        const head = [m[0] * x + m[1] * y + m[2] * z, m[4] * x + m[5] * y + m[6] * z, m[8] * x + m[9] * y + m[10] * z];
        const length = Math.hypot(head[0], head[1], head[2]) || 1;
        const turned = [0, 3, 6].map((row) => (R[row] * head[0] + R[row + 1] * head[1] + R[row + 2] * head[2]) / length);
        harmonics(turned[0], turned[1], turned[2], values);
      }
      for (let channel = 0; channel < 3; ++channel) {
        let sum = out[o + channel];
        for (let k = 0, s = 3 * (i * (rest + 1) + 1) + channel; k < rest; ++k, s += 3) sum += values[k] * sh[s];
        out[o + channel] = Math.max(sum, 0);
      }
    }
  }
}

/** Sides of the eyes, and the sign of a turn to the person's left that is outwards. */
const EYES = [["Left", 1], ["Right", -1]] as const;
/** The angle of the eyes at a coefficient of 1 of ARKit's names of gaze, in radians. */
const LOOK_ANGLE = Math.PI / 6;

/** An avatar in a scene: its face, its motion, and where it looks. An adapter gives it an object of its engine. */
export class Actor {
  /** The face, without what `lookAt` adds. After changing it, call `change`. */
  readonly face: Face;
  readonly source: GaussianSource;
  /** Whether a motion runs, its time in seconds, and whether it begins again at its end. */
  playing = false;
  time = 0;
  loop = true;
  /** Changes a copy of the face before it is shown: signs of life (`enliven` of mien-web/motion). */
  alive: ((face: Face) => void) | null = null;
  private target: ArrayLike<number> | null = null;
  private stale = true;

  /** `matrix` gives the transform of its object, from the head to the scene: 16 numbers, column by column. */
  constructor(readonly avatar: Avatar, public motion: Motion | null, private readonly matrix: () => ArrayLike<number>) {
    this.face = copyFace(avatar.neutral);
    this.source = new GaussianSource(avatar);
  }

  /** Shows a face: all its parts, or strengths by names (smile, jawOpen, eyeLookUpLeft, ..) with the rest at rest. False if a name does nothing. */
  setFace(face: Face | Record<string, number>): boolean {
    const look = new Map<string, number>(), whole = "head_rotation" in face;
    const shown = (whole ? face : this.avatar.neutral) as Face;
    for (const part of ["expression", "joints", "head_rotation", "head_translation"] as const) this.face[part].set(shown[part]);
    this.change();
    return whole || Object.entries(face).every(([name, value]) => setNamed(this.avatar, this.face, look, name, value));
  }

  /** Plays a motion, or goes on with it. `update` moves it. */
  play(motion: Motion | null = this.motion): void {
    if (motion !== this.motion) this.time = 0;
    this.motion = motion;
    this.playing = motion !== null;
  }

  pause(): void {
    this.playing = false;
  }

  /** Lets the eyes look at a point of the scene, as far as eyes turn; null lets go. */
  lookAt(point: ArrayLike<number> | null): void {
    this.target = point && Array.from(point);
    this.change();
  }

  /** Has the face posed again, because it has changed. */
  change(): void {
    this.stale = true;
  }

  /** Moves the motion on by seconds. */
  update(seconds: number): void {
    const { motion } = this;
    if (this.alive) this.change();
    if (!this.playing || !motion) return;
    const length = motionLength(motion) / motion.fps;
    this.time += seconds;
    if (this.time >= length && !this.loop) this.playing = false;
    this.time = this.loop ? this.time % length : Math.min(this.time, length - 0.5 / motion.fps);
    this.setFace(motionFace(motion, Math.floor(this.time * motion.fps)));
  }

  /** Whether what is seen differs from the last pose: the face, or with a target of the eyes its place, too. */
  get changed(): boolean {
    return this.stale;
  }

  /** Fills arrays with the Gaussians in the scene, or with `local`, in the frame of the object. */
  pose(into: Gaussians, { first, eye }: Omit<Place, "transform"> = {}, local = false): void {
    const shown = copyFace(this.face), m = this.matrix();
    if (this.target) this.gaze(shown, this.target, m);
    this.alive?.(shown);
    standStill(shown, this.avatar);
    const motion = this.headMotion(shown), h = [0, 1, 2, 3].flatMap((column) => [motion[column], motion[4 + column], motion[8 + column], column === 3 ? 1 : 0]);
    this.source.pose(shown, into, { first, eye: eye && local ? inside(m, eye) : eye, transform: local ? h : product(m, h) });
    this.stale = false;
  }

  /** How the head moved from its pose at rest, in its own frame there: rows of [R | t]. */
  private headMotion({ head_rotation, head_translation }: Face): Float64Array {
    const { neutral } = this.avatar, back = transposed(rotationMatrix(neutral.head_rotation, 0));
    const away = moved(rigid(back, [0, 0, 0]), neutral.head_translation).map((x) => -x);
    return chained(rigid(back, away), rigid(rotationMatrix(head_rotation, 0), head_translation));
  }

  private gaze(face: Face, target: ArrayLike<number>, m: ArrayLike<number>): void {
    const { avatar } = this, rig = "rig" in avatar.baked ? avatar.baked.rig : null, point = inside(m, target), look = new Map<string, number>();
    for (const [side, left] of EYES) {
      const joint = 3 * (rig?.joint_names.indexOf(`${side.toLowerCase()}_eye`) ?? -1);
      if (!rig || joint < 0) continue;
      const [x, y, z] = [0, 1, 2].map((axis) => point[axis] - rig.joint_template[joint + axis]);
      const out = (left * Math.atan2(x, Math.max(z, 1e-3))) / LOOK_ANGLE, up = Math.atan2(y, Math.hypot(x, Math.max(z, 1e-3))) / LOOK_ANGLE;
      for (const [way, value] of [["Out", out], ["In", -out], ["Up", up], ["Down", -up]] as const) setNamed(avatar, face, look, `eyeLook${way}${side}`, Math.max(value, 0));
    }
  }
}

/** The product of transforms, column by column. */
export function product(a: ArrayLike<number>, b: ArrayLike<number>): number[] {
  return Array.from({ length: 16 }, (_, i) => {
    const row = i % 4, column = i - row;
    return a[row] * b[column] + a[4 + row] * b[column + 1] + a[8 + row] * b[column + 2] + a[12 + row] * b[column + 3];
  });
}

/** A point of the scene in the frame of an object without shear. */
export function inside(m: ArrayLike<number>, point: ArrayLike<number>): number[] {
  const d = [0, 1, 2].map((axis) => point[axis] - m[12 + axis]);
  return [0, 4, 8].map((c) => (m[c] * d[0] + m[c + 1] * d[1] + m[c + 2] * d[2]) / (m[c] ** 2 + m[c + 1] ** 2 + m[c + 2] ** 2));
}
