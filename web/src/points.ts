// Gaussians whose centres are points of their own rig, or fixed in the head frame, posed on the CPU. It follows
// `_pose_blend_skinned`, `_raw_values` and `run_network` in src/mien/runtime/posing.py.

import type { AttributeNetwork, BlendSkinned, Face, LinearBases, Static } from "./avatar";
import { SLOPE } from "./features";
import { RigPoser, activations, inputsOf } from "./rig";
import { chained, moved, rigid, rotationMatrix, transposed } from "./rigid";

const SH_C0 = 0.28209479177387814;
/** Numbers of each Gaussian in the raw values that change. */
export const WIDTHS: Record<string, number> = { means: 3, quats: 4, log_scales: 3, opacity_logits: 1, sh: 3 };

const sigmoid = (x: number): number => 1 / (1 + Math.exp(-x));

/** What all posed Gaussians have. At first, it holds the values at rest. */
interface Posed {
  readonly means: Float32Array;
  readonly opacityLogits: Float32Array;
  readonly colors: Float32Array;
}

export class PointPoser {
  /** Raw rotations [n, 4], wxyz. */
  readonly quats: Float32Array;
  /** Standard deviations [n, 3], in metres. */
  readonly scales: Float32Array;
  private readonly rig: RigPoser | null;
  /** Values at rest, and where those of a face go. */
  private readonly parts: Record<string, { rest: Float32Array; to: Float32Array }>;
  /** Inputs of the network, and outputs of its layers. */
  private readonly layers: Float64Array[];

  /** Poses write into `out`. */
  constructor(private readonly baked: BlendSkinned | Static, private readonly out: Posed) {
    const { quats, log_scales } = baked.attributes, { network } = baked;
    this.quats = quats.slice();
    this.scales = log_scales.slice();
    this.rig = baked.kind === "Static" ? null : new RigPoser(baked.rig);
    const part = (to: Float32Array) => ({ rest: to.slice(), to });
    this.parts = {
      means: part(out.means), quats: part(this.quats), log_scales: part(this.scales),
      opacity_logits: part(out.opacityLogits), sh: part(out.colors),
    };
    const sizes = network ? [network.weights[0].length / network.biases[0].length, ...network.biases.map((bias) => bias.length)] : [];
    this.layers = sizes.map((size) => new Float64Array(size));
  }

  pose(face: Face): void {
    const { baked, out, parts, rig, scales } = this, { bases, network } = baked, { colors, means } = out;
    for (const name in parts) {
      const { rest, to } = parts[name], basis = bases?.[name as keyof LinearBases], size = to.length;
      to.set(rest);
      if (basis) face.expression.forEach((weight, e) => weight && to.forEach((_, k) => (to[k] += weight * basis[e * size + k])));
    }
    if (rig) means.set(rig.pose(face));
    const skinned = baked.kind === "BlendSkinned" ? baked : null;
    if (rig && skinned) addStill(skinned, rig.shaped, face, means);
    if (network) this.addNetwork(network, face);
    const small = skinned?.scale_activation === "sigmoid";
    scales.forEach((raw, k) => (scales[k] = small ? skinned.scale_gain * sigmoid(raw) + skinned.scale_offset : Math.exp(raw)));
    if (skinned?.color_activation === "sigmoid") colors.forEach((raw, k) => (colors[k] = (sigmoid(raw) - 0.5) / SH_C0));
  }

  private addNetwork({ base, weights, biases, activation, outputs, along }: AttributeNetwork, face: Face): void {
    const { layers, parts } = this, { rest, to } = parts.means, count = rest.length / 3, found = layers[biases.length];
    const own = base.length / count, [inputs] = layers, { basis } = along ?? { basis: [] };
    const strengths = along ? activations(inputsOf(face), along) : [], features = basis.length / count / strengths.length;
    for (let i = 0, b = 0; i < count; ++i) {
      inputs.set(base.subarray(i * own, (i + 1) * own));
      for (const strength of strengths) for (let f = 0; f < features; ++f) inputs[f] += strength * basis[b++];
      // Points without a rig do not move for the network.
      if (!along && this.rig) for (let p = 3 * i, axis = 0; axis < 3; ++axis, ++p) inputs[own + axis] = to[p] - rest[p];
      run(weights, biases, layers, activation);
      let from = 0;
      for (const name of outputs) {
        const values = parts[name].to, width = values.length / count;
        for (let k = 0; k < width; ++k) values[i * width + k] += found[from++];
      }
    }
  }
}

/** The bone that stands still in the world: inverse(T_world_head) still_pose of the points before skinning. */
function addStill({ still_weights: weights, still_pose: pose }: BlendSkinned, shaped: Float64Array, face: Face, points: Float32Array): void {
  if (!weights || !pose) return;
  const R = transposed(rotationMatrix(face.head_rotation, 0)), back = moved(rigid(R, [0, 0, 0]), face.head_translation).map((x) => -x);
  const T = chained(rigid(R, back), pose);
  for (let i = 0, p = 0; i < weights.length; ++i, p += 3)
    for (let axis = 0, r = 0; axis < 3; ++axis, r += 4)
      points[p + axis] += weights[i] * (T[r] * shaped[p] + T[r + 1] * shaped[p + 1] + T[r + 2] * shaped[p + 2] + T[r + 3]);
}

/** Runs the layers of a network on the inputs in the first of `layers`. The others are their outputs. */
function run(weights: Float32Array[], biases: Float32Array[], layers: Float64Array[], activation: AttributeNetwork["activation"]): void {
  biases.forEach((bias, layer) => {
    const from = layers[layer], to = layers[layer + 1], weight = weights[layer];
    for (let o = 0, w = 0; o < to.length; ++o) {
      let sum = bias[o];
      for (let k = 0; k < from.length; ++k) sum += weight[w++] * from[k];
      if (layer + 1 < biases.length) {
        if (activation === "softplus") sum = Math.max(sum, 0) + Math.log1p(Math.exp(-Math.abs(sum)));
        else if (sum < 0) sum *= activation === "relu" ? 0 : SLOPE;
      }
      to[o] = sum;
    }
  });
}
