// Gaussians that have their own blend directions and skinning weights (mono_gaussian_avatar), posed on the CPU. It
// follows `_pose_blend_skinned` in src/mien/runtime/posing.py.

import type { Avatar, BlendSkinned, Face, MeshBound, PointNetwork } from "./avatar";
import { RigPoser } from "./rig";
import { chained, rigid, rotationMatrix } from "./rigid";

const SH_C0 = 0.28209479177387814;
const WIDTHS: Record<string, number> = { quats: 4, log_scales: 3, opacity_logits: 1, sh: 3 };

const sigmoid = (x: number): number => 1 / (1 + Math.exp(-x));

/** Why such Gaussians cannot be posed here; an empty text if they can. */
export function skinnedFault({ rig, attributes, bases, network, still_weights, still_pose }: BlendSkinned): string {
  const count = rig.template.length / 3;
  if (bases || network?.input !== "displacement" || network.activation !== "relu") return "has a network that this page cannot draw";
  let before = network.base.length / Math.max(count, 1) + 3, fits = network.weights.length === network.biases.length;
  network.biases.forEach((bias, layer) => {
    fits &&= network.weights[layer].length === before * bias.length;
    before = bias.length;
  });
  fits &&= before === network.outputs.reduce((sum, name) => sum + (WIDTHS[name] ?? NaN), 0);
  fits &&= attributes.sh.length === 3 * count;
  fits &&= !still_weights === !still_pose && (!still_weights || still_weights.length === count);
  return fits ? "" : "is damaged: its arrays do not fit together";
}

/** The same avatar as Gaussians on one triangle, whose frame is always the head's, and what moves them. */
export function onTriangle(avatar: Avatar): Avatar {
  const skinned = avatar.baked as unknown as BlendSkinned, { rig, attributes } = skinned;
  const baked: MeshBound = {
    kind: "MeshBound", rig, faces: new Int32Array(3), face_index: new Int32Array(rig.template.length / 3), means: rig.template, attributes,
    sh_frame: "head", skinned,
  };
  return { ...avatar, baked };
}

/** Where posing writes what the triangle's Gaussians have anyway. */
interface Written {
  readonly means: Float32Array;
  readonly opacityLogits: Float32Array;
  readonly colors: Float32Array;
}

export class SkinnedPoser {
  /** Raw rotations [n, 4], wxyz. */
  readonly quats: Float32Array;
  /** Standard deviations [n, 3], in metres. */
  readonly scales: Float32Array;
  readonly rig: RigPoser;
  private readonly layers: Float64Array[];

  constructor(private readonly baked: BlendSkinned) {
    this.quats = baked.attributes.quats.slice();
    this.scales = new Float32Array(baked.attributes.log_scales.length);
    this.rig = new RigPoser(baked.rig);
    const { base, biases } = baked.network, inputs = (3 * base.length) / Math.max(baked.rig.template.length, 1) + 3;
    this.layers = [inputs, ...biases.map((bias) => bias.length)].map((size) => new Float64Array(size));
  }

  /** Writes the Gaussians of a face. */
  pose(face: Face, out: Written): void {
    out.means.set(this.rig.pose(face));
    this.addStill(face, out.means);
    const { attributes, rig, network, scale_activation, scale_gain, scale_offset, color_activation } = this.baked;
    const scale = scale_activation === "sigmoid" ? (x: number) => scale_gain * sigmoid(x) + scale_offset : Math.exp;
    const color = color_activation === "sigmoid" ? (x: number) => (sigmoid(x) - 0.5) / SH_C0 : (x: number) => x;
    const parts: Record<string, [Float32Array, Float32Array, (x: number) => number]> = {
      quats: [attributes.quats, this.quats, (x) => x], log_scales: [attributes.log_scales, this.scales, scale],
      opacity_logits: [attributes.opacity_logits, out.opacityLogits, (x) => x], sh: [attributes.sh, out.colors, color],
    };
    for (const name of Object.keys(parts)) {
      if (network.outputs.includes(name)) continue;
      const [raw, to, activated] = parts[name];
      raw.forEach((value, k) => (to[k] = activated(value)));
    }
    const targets = network.outputs.map((name) => ({ width: WIDTHS[name], part: parts[name] }));
    const inputs = this.layers[0], own = inputs.length - 3;
    for (let i = 0, p = 0; p < rig.template.length; ++i, p += 3) {
      for (let k = 0; k < own; ++k) inputs[k] = network.base[i * own + k];
      for (let axis = 0; axis < 3; ++axis) inputs[own + axis] = out.means[p + axis] - rig.template[p + axis];
      const found = run(network, this.layers);
      let from = 0;
      for (const { width, part: [raw, to, activated] } of targets)
        for (let k = i * width; k < (i + 1) * width; ++k) to[k] = activated(raw[k] + found[from++]);
    }
  }

  /** The bone that stands still in the world: inverse(T_world_head) still_pose of the points before skinning. */
  private addStill(face: Face, points: Float32Array): void {
    const { still_weights: weights, still_pose: pose } = this.baked, { shaped } = this.rig;
    if (!weights || !pose) return;
    const R = rotationMatrix(face.head_rotation, 0), t = face.head_translation;
    const back = [0, 1, 2].map((column) => -(R[column] * t[0] + R[3 + column] * t[1] + R[6 + column] * t[2]));
    const T = chained(rigid([R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]], back), pose);
    for (let i = 0, p = 0; i < weights.length; ++i, p += 3)
      for (let axis = 0, r = 0; axis < 3; ++axis, r += 4)
        points[p + axis] += weights[i] * (T[r] * shaped[p] + T[r + 1] * shaped[p + 1] + T[r + 2] * shaped[p + 2] + T[r + 3]);
  }
}

/** The outputs for the inputs in the first of `layers`. They are the last of `layers`. */
function run({ weights, biases }: PointNetwork, layers: Float64Array[]): Float64Array {
  for (let layer = 0; layer < biases.length; ++layer) {
    const from = layers[layer], to = layers[layer + 1], weight = weights[layer], bias = biases[layer];
    const last = layer + 1 === biases.length;
    for (let o = 0, w = 0; o < to.length; ++o) {
      let sum = bias[o];
      for (let k = 0; k < from.length; ++k) sum += weight[w++] * from[k];
      to[o] = last || sum > 0 ? sum : 0;
    }
  }
  return layers[biases.length];
}
