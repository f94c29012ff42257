// Posing on the GPU: frames of triangles, changes with the expression, and the network of features. The rig's points and
// the activations come from the CPU (rig.ts). Gaussians that are bound to no mesh are posed on the CPU (points.ts).

import type { ExpressionChanges, FeatureChanges, MeshBound } from "./avatar";
import { ownPart, sizesOf } from "./features";
import { AvatarError } from "./format";
import { dispatch, type Memory } from "./gpu_memory";
import { FRAMES, MOST_RANK, THREADS, change, featureNetwork } from "./gpu_shaders";
import { type Poser, layoutOf } from "./rig";

/** TypeScript has no type of it yet. Browsers have it since 2025. */
declare const Float16Array: undefined | (new (from: Float32Array) => { buffer: ArrayBuffer });

/** Numbers of the structure `Pose` of the shaders, before the activations. */
const POSE_SIZE = 8;

interface Step {
  pipeline: GPUComputePipeline;
  group: GPUBindGroup;
  threads: number;
}

/** Where the Gaussians of a picture are. */
export interface Posed {
  /** Rows of [k R | T] of each triangle. */
  frames: GPUBuffer;
  /** Centres in the frames of triangles, and the triangle. */
  means: GPUBuffer;
  /** First colour coefficients, and the raw opacity. */
  colors: GPUBuffer;
}

export class GpuPoser {
  private readonly points: GPUBuffer;
  private readonly pose: GPUBuffer;
  private readonly frames: Step;
  /** What depends on the activations. */
  private readonly changes: Step[] = [];
  private readonly told: Float32Array<ArrayBuffer>;

  /** `means` and `colours` are those at rest, in rows of four as the buffers have them. */
  constructor(private readonly memory: Memory, baked: MeshBound, posed: Posed, means: Float32Array, colors: Float32Array) {
    const { rig, faces, changes } = baked, count = baked.face_index.length, triangles = faces.length / 3;
    this.points = memory.storage(rig.template.length);
    this.told = new Float32Array(POSE_SIZE + MOST_RANK);
    this.pose = memory.uniform(this.told.length);
    const words = new Uint32Array(this.told.buffer);
    words[0] = count;
    words[1] = triangles;
    this.frames = this.step(FRAMES, triangles, [this.pose, this.points, memory.storage(faces), posed.frames]);
    if (!changes) return;
    const { regions, width } = layoutOf(changes, triangles);
    if (regions * width > MOST_RANK) throw new AvatarError(`has more than ${MOST_RANK} activations`);
    const shares = memory.storage(changes.shares ?? new Float32Array(triangles).fill(1));
    const { basis, columns } = basisOf(changes, count);
    words[2] = columns;
    const rest = [means, colors].map((values) => memory.storage(values));
    this.changes.push(this.step(change(regions, width), count, [this.pose, ...rest, memory.storage(basis), posed.means, posed.colors, shares]));
    if (changes.features) this.addNetwork(changes.features, count, regions, [posed.colors, shares, posed.means]);
  }

  /** Poses the Gaussians of the poser's last face. */
  run(poser: Poser): void {
    const { device } = this.memory;
    this.memory.write(this.points, poser.points);
    const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
    const steps = [this.frames];
    if (poser.changed) {
      this.told.set(poser.activations, POSE_SIZE);
      steps.push(...this.changes);
    }
    this.memory.write(this.pose, this.told);
    for (const { pipeline, group, threads } of steps) dispatch(pass, pipeline, group, Math.ceil(threads / THREADS));
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  private addNetwork(features: FeatureChanges, count: number, regions: number, last: GPUBuffer[]): void {
    const { memory } = this, { width, rank, hidden } = sizesOf(features, count), { weights, biases } = features;
    const texels = Math.ceil(width / 4), units = 4 * Math.ceil(hidden / 4), columns = weights[0].length / hidden;
    // For each hidden unit: its weights of the features, then those of the four outputs.
    const table = new Float32Array(4 * (texels + 1) * units);
    for (let h = 0; h < hidden; ++h) {
      const row = 4 * (texels + 1) * h;
      table.set(weights[0].subarray(h * columns, h * columns + width), row);
      for (let o = 0; o < 4; ++o) table[row + 4 * texels + o] = weights[1][o * hidden + h];
    }
    this.told.set(biases[1], 4);
    const half = (values: Float32Array, row: number) => memory.storage(halves(padded(values, row)));
    const own = half(ownPart(features, count, width), hidden);
    const inputs = [half(features.neutral, width), half(features.basis, width), own, memory.storage(table)];
    this.changes.push(this.step(featureNetwork(texels, rank, units, regions), count, [this.pose, ...inputs, ...last]));
  }

  private step(code: string, threads: number, buffers: GPUBuffer[]): Step {
    const { device } = this.memory;
    const pipeline = device.createComputePipeline({ layout: "auto", compute: { module: device.createShaderModule({ code }) } });
    return { pipeline, group: this.memory.group(pipeline.getBindGroupLayout(0), buffers), threads };
  }
}

/** The bases of centres, raw opacities and colours together: eight numbers for each Gaussian and activation. */
function basisOf({ means, opacity_logits, color }: ExpressionChanges, count: number): { basis: Float32Array; columns: number } {
  const parts = [{ part: means, width: 3, at: 0 }, { part: opacity_logits, width: 1, at: 3 }, { part: color, width: 3, at: 4 }];
  const columnsOf = (part: Float32Array | null, width: number) => (part?.length ?? 0) / width / Math.max(count, 1);
  const columns = Math.max(...parts.map(({ part, width }) => columnsOf(part, width)));
  const basis = new Float32Array(8 * count * columns);
  for (const { part, width, at } of parts) {
    const own = columnsOf(part, width);
    for (let i = 0, from = 0; i < count; ++i)
      for (let axis = 0; axis < width; ++axis) for (let k = 0; k < own; ++k) basis[8 * (i * columns + k) + at + axis] = part![from++];
  }
  return { basis, columns };
}

/** Rows of `width` numbers in rows of whole fours. */
function padded(from: Float32Array, width: number): Float32Array {
  const to = 4 * Math.ceil(width / 4), rows = from.length / width;
  if (to === width) return from;
  const out = new Float32Array(rows * to);
  for (let row = 0; row < rows; ++row) out.set(from.subarray(row * width, (row + 1) * width), row * to);
  return out;
}

/** Two half floats in each number. */
function halves(values: Float32Array): Uint32Array {
  if (typeof Float16Array === "undefined") throw new AvatarError("needs half floats, which this browser's WebGPU lacks");
  return new Uint32Array(new Float16Array(values).buffer);
}
