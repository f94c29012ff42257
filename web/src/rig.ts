// Posing on the CPU: points of the rig, frames of triangles, changes with the expression, depths. It follows
// src/mien/runtime/posing.py, FaceModel.head_vertices_reference and triangle_frames.

import type { Baked, ExpressionChanges, Face, HeadActivations, MeshBound, Rig } from "./avatar";
import { type Activations, FeatureNetwork } from "./features";
import { PointPoser } from "./points";
import { chained, multiplied, rigid, rotationMatrix, transposed } from "./rigid";

/** Rows of a basis [rows, m, 3] without its zeros: most expressions move a small part of the face. */
class SparseBasis {
  private readonly rows: { index: Int32Array; change: Float32Array }[] = [];

  constructor(basis: Float32Array, rows: number) {
    const width = rows ? basis.length / rows : 0;
    for (let row = 0; row < rows; ++row) {
      const part = basis.subarray(row * width, (row + 1) * width), used: number[] = [];
      for (let i = 0; i < width; i += 3) if (part[i] || part[i + 1] || part[i + 2]) used.push(i);
      const change = new Float32Array(3 * used.length);
      used.forEach((i, k) => change.set(part.subarray(i, i + 3), 3 * k));
      this.rows.push({ index: Int32Array.from(used), change });
    }
  }

  /** Adds a row times a weight. */
  add(row: number, weight: number, out: Float32Array | Float64Array): void {
    if (weight === 0) return;
    const { index, change } = this.rows[row];
    for (let k = 0, c = 0; k < index.length; ++k, c += 3) {
      const i = index[k];
      out[i] += weight * change[c];
      out[i + 1] += weight * change[c + 1];
      out[i + 2] += weight * change[c + 2];
    }
  }
}

/** The rig's points for any face. */
export class RigPoser {
  private readonly expressions: SparseBasis;
  private readonly correctives: SparseBasis | null;
  /** Points before skinning. */
  readonly shaped: Float64Array;
  private readonly points: Float32Array;
  private readonly follows: { joint: Int32Array; weight: Float32Array; start: Int32Array };

  constructor(private readonly rig: Rig) {
    this.expressions = new SparseBasis(rig.expression_basis, rig.expression_names.length);
    const free = rig.joint_free.filter(Boolean).length;
    this.correctives = rig.pose_basis && new SparseBasis(rig.pose_basis, 9 * free);
    this.shaped = new Float64Array(rig.template.length);
    this.points = new Float32Array(rig.template.length);
    this.follows = sparseWeights(rig.skinning_weights, rig.joint_names.length);
  }

  /** Points in the head frame [m, 3], in metres. The next call writes into the same array. */
  pose(face: Face): Float32Array {
    const { rig, shaped } = this;
    shaped.set(rig.template);
    for (let e = 0; e < face.expression.length; ++e) this.expressions.add(e, face.expression[e], shaped);
    if (this.correctives)
      for (let j = 0; 3 * j < face.joints.length; ++j) {
        const turn = rotationMatrix(face.joints, 3 * j);
        for (let c = 0; c < 9; ++c) this.correctives.add(9 * j + c, turn[c] - (c % 4 ? 0 : 1), shaped);
      }
    this.skin(this.jointTransforms(face));
    return this.points;
  }

  /** The transform of each joint, twelve numbers: the rows of [R | t]. */
  private jointTransforms(face: Face): Float64Array[] {
    const { rig } = this, count = rig.joint_names.length, all: Float64Array[] = [];
    for (let joint = 0, free = 0; joint < count; ++joint) {
      const turn = new Float64Array(3), shift = new Float64Array(3);
      for (let e = 0; e < face.expression.length; ++e)
        for (let axis = 0; axis < 3; ++axis) {
          const at = 3 * (e * count + joint) + axis;
          turn[axis] += face.expression[e] * rig.joint_rotation_basis[at];
          shift[axis] += face.expression[e] * rig.joint_translation_basis[at];
        }
      if (rig.joint_free[joint]) turn.set(face.joints.subarray(3 * free, 3 * ++free));
      const R = rotationMatrix(turn, 0), rest = rig.joint_template.subarray(3 * joint, 3 * joint + 3);
      const about = [0, 1, 2].map((row) => rest[row] + shift[row] - (R[3 * row] * rest[0] + R[3 * row + 1] * rest[1] + R[3 * row + 2] * rest[2]));
      const local = rigid(R, about), parent = rig.joint_parents[joint];
      all.push(parent < 0 ? local : chained(all[parent], local));
    }
    return all;
  }

  private skin(transforms: Float64Array[]): void {
    const { shaped, points } = this, { joint, weight, start } = this.follows, T = new Float64Array(12);
    for (let v = 0, p = 0; p < points.length; ++v, p += 3) {
      T.fill(0);
      for (let k = start[v]; k < start[v + 1]; ++k) {
        const from = transforms[joint[k]], w = weight[k];
        for (let c = 0; c < 12; ++c) T[c] += w * from[c];
      }
      const x = shaped[p], y = shaped[p + 1], z = shaped[p + 2];
      points[p] = T[0] * x + T[1] * y + T[2] * z + T[3];
      points[p + 1] = T[4] * x + T[5] * y + T[6] * z + T[7];
      points[p + 2] = T[8] * x + T[9] * y + T[10] * z + T[11];
    }
  }
}

function sparseWeights(weights: Float32Array, joints: number): { joint: Int32Array; weight: Float32Array; start: Int32Array } {
  const joint: number[] = [], weight: number[] = [], start = [0];
  for (let i = 0; i < weights.length; ++i) {
    if (weights[i] !== 0) {
      joint.push(i % joints);
      weight.push(weights[i]);
    }
    if (i % joints === joints - 1) start.push(joint.length);
  }
  return { joint: Int32Array.from(joint), weight: Float32Array.from(weight), start: Int32Array.from(start) };
}

/** Shortest first edge or height of a triangle that has a frame of its own, in metres. */
const DEGENERATE_LENGTH = 1e-7;

/**
 * Twelve numbers for each triangle: the rows of [k R | T], so that world = k R local + T. R's columns are the direction
 * of the first edge, the normal and their cross product; k is the mean of that edge's length and the height over it.
 */
export function triangleFrames(points: Float32Array, faces: Int32Array, out: Float32Array): void {
  for (let f = 0, o = 0; f < faces.length; f += 3, o += 12) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    let ex = points[b] - points[a], ey = points[b + 1] - points[a + 1], ez = points[b + 2] - points[a + 2];
    let sx = points[c] - points[a], sy = points[c + 1] - points[a + 1], sz = points[c + 2] - points[a + 2];
    let nx = ey * sz - ez * sy, ny = ez * sx - ex * sz, nz = ex * sy - ey * sx;
    let edge = Math.sqrt(ex * ex + ey * ey + ez * ez);
    if (edge < DEGENERATE_LENGTH || Math.sqrt(nx * nx + ny * ny + nz * nz) < DEGENERATE_LENGTH * edge) {
      ex = sy = edge = DEGENERATE_LENGTH;
      ey = ez = sx = sz = 0;
    }
    ex /= edge; ey /= edge; ez /= edge;
    nx = ey * sz - ez * sy; ny = ez * sx - ex * sz; nz = ex * sy - ey * sx;
    const height = Math.sqrt(nx * nx + ny * ny + nz * nz), k = (edge + height) / 2;
    nx /= height; ny /= height; nz /= height;
    out[o] = k * ex; out[o + 1] = k * nx; out[o + 2] = k * (ey * nz - ez * ny);
    out[o + 4] = k * ey; out[o + 5] = k * ny; out[o + 6] = k * (ez * nx - ex * nz);
    out[o + 8] = k * ez; out[o + 9] = k * nz; out[o + 10] = k * (ex * ny - ey * nx);
    for (let axis = 0; axis < 3; ++axis) out[o + 4 * axis + 3] = (points[a + axis] + points[b + axis] + points[c + axis]) / 3;
  }
}

/** How far activations get beyond what training saw along them, as a share of it, as in native/expression_change.cpp. */
const MARGIN = 0.1;

/** What activations are made of. */
export interface Directions {
  rest: ArrayLike<number>; // [i]
  directions: Float32Array; // [i, r]
}

/** (inputs - rest) directions, in each of some regions shortened to what training saw. */
export function activations(inputs: number[], { rest, directions }: Directions, seen?: Float32Array, regions = 1): Float64Array {
  const rank = directions.length / inputs.length, block = rank / regions, out = new Float64Array(rank);
  inputs.forEach((input, i) => {
    for (let k = 0; k < rank; ++k) out[k] += (input - rest[i]) * directions[i * rank + k];
  });
  for (let begin = 0; seen?.length && begin < rank; begin += block) {
    const own = out.subarray(begin, begin + block), along = (row: ArrayLike<number>, from: number) => own.reduce((sum, x, k) => sum + x * row[from + k], 0);
    let furthest = 1e-6;
    for (let from = begin; from < seen.length; from += rank) furthest = Math.max(furthest, along(seen, from));
    const ratio = along(own, 0) / furthest, over = ratio - 1;
    if (over > 0) own.forEach((x, k) => (own[k] = (x * (1 + (MARGIN * over) / (MARGIN + over))) / ratio));
  }
  return out;
}

/** The inputs of a face: its coefficients, then the angles of its joints. */
export const inputsOf = (face: Face): number[] => [...face.expression, ...face.joints];

/** How the head moved from its pose at rest: sines of its turns about its own axes there, then its shift. */
function headMotion({ rest }: HeadActivations, face: Face): number[] {
  const back = transposed(rotationMatrix(rest, 0)), R = multiplied(back, rotationMatrix(face.head_rotation, 0));
  const [x, y, z] = [0, 1, 2].map((axis) => face.head_translation[axis] - rest[3 + axis]);
  const shift = [0, 3, 6].map((row) => back[row] * x + back[row + 1] * y + back[row + 2] * z);
  return [(R[7] - R[5]) / 2, (R[2] - R[6]) / 2, (R[3] - R[1]) / 2, ...shift];
}

/** The sizes of a face's activations: regions, and the activations of a Gaussian, of its region and of the head. */
export function layoutOf({ rest, directions, shares, head }: ExpressionChanges, triangles: number): { regions: number; own: number; width: number } {
  const regions = shares ? shares.length / Math.max(triangles, 1) : 1, own = directions.length / rest.length / regions;
  return { regions, own, width: own + (head ? head.directions.length / 6 : 0) };
}

/** A row of a Gaussian's activations for each region [g, a]: one of the region and one of the head in turn, as long as there are both. */
function tableOf(changes: ExpressionChanges, face: Face, { regions, own, width }: ReturnType<typeof layoutOf>): Float64Array {
  const found = activations(inputsOf(face), changes, changes.seen, regions), { head } = changes, out = new Float64Array(regions * width);
  const pose = head ? activations(headMotion(head, face), { rest: new Float64Array(6), directions: head.directions }, head.seen) : [];
  for (let region = 0, o = 0; region < regions; ++region)
    for (let k = 0; k < Math.max(own, width - own); ++k) {
      if (k < own) out[o++] = found[region * own + k];
      if (k < width - own) out[o++] = pose[k];
    }
  return out;
}

/** raw + basis times the first activations of each Gaussian's triangle, into `out`. */
function changed(raw: Float32Array, basis: Float32Array | null, { table, rows, width }: Activations, out: Float32Array): void {
  if (!basis) return;
  const rank = basis.length / Math.max(out.length, 1), each = out.length / Math.max(rows.length, 1);
  for (let i = 0, b = 0; i < out.length; ++i) {
    const from = width * rows[Math.floor(i / each)];
    let sum = raw[i];
    for (let k = 0; k < rank; ++k) sum += basis[b++] * table[from + k];
    out[i] = sum;
  }
}

/** All that depends on the face: frames of triangles, and the values that change with the expression. */
export class Poser {
  /** The record if its Gaussians are bound to triangles, else null. */
  readonly bound: MeshBound | null;
  /** What poses Gaussians that are bound to none. */
  readonly free: PointPoser | null = null;
  /** The triangle of each Gaussian. Gaussians that are bound to none have one, whose frame is always the head's. */
  readonly faceIndex: Int32Array;
  /** Rows of [k R | T] of each triangle, in the head frame. */
  readonly frames: Float32Array = Float32Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0);
  /** Centres in the frames of triangles. */
  readonly means: Float32Array;
  /** Raw opacities. */
  readonly opacityLogits: Float32Array;
  /** First colour coefficients [n, 3]. */
  readonly colors: Float32Array;
  /** Points of the head at rest. */
  readonly rest: Float32Array;
  /** The mesh's points in the head frame. */
  points: Float32Array = new Float32Array();
  private readonly rig: RigPoser | null = null;
  /** The activations of the changes at the last face: a row for each region of the face. */
  activations: Float64Array = new Float64Array();
  private readonly layout = { regions: 1, own: 0, width: 0 };
  /** Whether the last face has changed means, colours or opacities. */
  changed = false;
  /** Whether posing runs the network of features. Not where the renderer runs it on the GPU. */
  runsNetwork = true;
  /** Whether posing goes beyond the rig's points and the activations. Not where the renderer does all else on the GPU. */
  binds = true;
  private readonly restColors: Float32Array;
  private readonly network: FeatureNetwork | null = null;
  private posed = false;

  constructor(baked: Baked) {
    const { sh, opacity_logits } = baked.attributes, count = opacity_logits.length, width = sh.length / Math.max(count, 1);
    this.bound = baked.kind === "MeshBound" ? baked : null;
    const means = baked.kind === "BlendSkinned" ? baked.rig.template : baked.means;
    this.means = means.slice();
    this.opacityLogits = opacity_logits.slice();
    this.restColors = new Float32Array(3 * count);
    for (let i = 0; i < count; ++i) this.restColors.set(sh.subarray(i * width, i * width + 3), 3 * i);
    this.colors = this.restColors.slice();
    this.rest = means;
    if (baked.kind !== "MeshBound") {
      this.faceIndex = new Int32Array(count);
      this.free = new PointPoser(baked, this);
      return;
    }
    const { faces, rig, changes } = baked, features = changes?.features;
    this.faceIndex = baked.face_index;
    this.frames = new Float32Array(4 * faces.length);
    // A single triangle is not the head: it is the frame of Gaussians that do not move.
    if (faces.length > 3) this.rest = rig.template;
    this.rig = new RigPoser(rig);
    if (changes) this.layout = layoutOf(changes, faces.length / 3);
    this.activations = new Float64Array(this.layout.regions * this.layout.width);
    if (features) this.network = new FeatureNetwork(features, count);
  }

  pose(face: Face): void {
    const { bound, free, rig } = this;
    if (free) {
      free.pose(face);
      this.changed = true;
    }
    if (!bound || !rig) return;
    this.points = rig.pose(face);
    if (this.binds) triangleFrames(this.points, bound.faces, this.frames);
    const { changes, attributes } = bound;
    if (!changes) return;
    const weights = tableOf(changes, face, this.layout), before = this.activations;
    this.activations = weights;
    this.changed = !this.posed || weights.some((weight, k) => weight !== before[k]);
    if (!this.changed) return;
    this.posed = true;
    if (!this.binds) return;
    const all = this.ofTriangles(changes.shares);
    changed(bound.means, changes.means, all, this.means);
    changed(attributes.opacity_logits, changes.opacity_logits, all, this.opacityLogits);
    changed(this.restColors, changes.color, all, this.colors);
    if (!this.network || !this.runsNetwork) return;
    if (!changes.opacity_logits) this.opacityLogits.set(attributes.opacity_logits);
    if (!changes.color) this.colors.set(this.restColors);
    this.network.add(all, this.colors, this.opacityLogits);
  }

  /** The activations of each triangle, as the regions share it. */
  private ofTriangles(shares: Float32Array | null): Activations {
    const { regions, width } = this.layout, triangles = shares ? shares.length / regions : this.frames.length / 12;
    const table = new Float64Array(triangles * width);
    for (let f = 0; f < triangles; ++f)
      for (let region = 0; region < regions; ++region) {
        const share = shares ? shares[f * regions + region] : 1;
        if (share) for (let k = 0; k < width; ++k) table[f * width + k] += share * this.activations[region * width + k];
      }
    return { table, rows: this.faceIndex, width };
  }

  /** Depths of the centres along a row of a view of the head frame: x view[0] + y view[1] + z view[2] + view[3]. */
  depths(view: ArrayLike<number>, out: Float32Array): void {
    const { frames, means, faceIndex } = this, [x, y, z, w] = [view[0], view[1], view[2], view[3]];
    const rows = new Float32Array(frames.length / 3);
    for (let f = 0, r = 0; f < frames.length; f += 12, r += 4) {
      rows[r] = x * frames[f] + y * frames[f + 4] + z * frames[f + 8];
      rows[r + 1] = x * frames[f + 1] + y * frames[f + 5] + z * frames[f + 9];
      rows[r + 2] = x * frames[f + 2] + y * frames[f + 6] + z * frames[f + 10];
      rows[r + 3] = x * frames[f + 3] + y * frames[f + 7] + z * frames[f + 11] + w;
    }
    for (let i = 0, p = 0; i < out.length; ++i, p += 3) {
      const r = 4 * faceIndex[i];
      out[i] = rows[r] * means[p] + rows[r + 1] * means[p + 1] + rows[r + 2] * means[p + 2] + rows[r + 3];
    }
  }

  /** Centres in the head frame [n, 3]. Drawing computes them on the GPU; this is for tests and other programs. */
  centres(): Float32Array {
    const { frames, means, faceIndex } = this, out = new Float32Array(means.length);
    for (let i = 0, p = 0; p < out.length; ++i, p += 3) {
      const f = 12 * faceIndex[i];
      for (let row = 0; row < 3; ++row)
        out[p + row] = frames[f + 4 * row] * means[p] + frames[f + 4 * row + 1] * means[p + 1] + frames[f + 4 * row + 2] * means[p + 2] + frames[f + 4 * row + 3];
    }
    return out;
  }
}
