// The sort of one picture on the GPU: a radix sort of two passes. It keeps the order of equal keys.

import { SORT, TILE } from "./gpu_shaders";
import { dispatch, type Memory } from "./gpu_memory";

// TypeScript has the types of WebGPU, but not this.
declare const GPUShaderStage: { COMPUTE: number };

interface Digit {
  count: GPUComputePipeline;
  scan: GPUComputePipeline;
  scatter: GPUComputePipeline;
}

export class SortPipelines {
  readonly layout: GPUBindGroupLayout;
  readonly digits: Digit[];

  constructor(device: GPUDevice) {
    const types: GPUBufferBindingType[] = ["uniform", ...Array(3).fill("read-only-storage"), ...Array(3).fill("storage")];
    this.layout = device.createBindGroupLayout({
      entries: types.map((type, binding) => ({ binding, visibility: GPUShaderStage.COMPUTE, buffer: { type } })),
    });
    const layout = device.createPipelineLayout({ bindGroupLayouts: [this.layout] }), module = device.createShaderModule({ code: SORT });
    this.digits = [1, 0].map((FIRST) => {
      const of = (entryPoint: string) => device.createComputePipeline({ layout, compute: { module, entryPoint, constants: { FIRST } } });
      return { count: of("count"), scan: of("scan"), scatter: of("scatter") };
    });
  }
}

export class GpuSorter {
  /** Depths before, as bits of floats: the largest number for Gaussians that cannot be seen. */
  readonly keys: GPUBuffer;
  /** Indices afterwards, farthest first; those that cannot be seen come last. */
  readonly order: GPUBuffer;
  private readonly groups: GPUBindGroup[];

  /** `view` and `state` are the buffers of the structures `View` and `State` of the shaders. */
  constructor(private readonly pipelines: SortPipelines, memory: Memory, private readonly count: number, view: GPUBuffer, state: GPUBuffer) {
    const [keys, order, otherKeys, otherOrder] = Array.from({ length: 4 }, () => memory.storage(count));
    const starts = memory.storage(256 * Math.ceil(count / TILE));
    const passes = [[keys, order, otherKeys, otherOrder], [otherKeys, otherOrder, keys, order]];
    this.groups = passes.map((four) => memory.group(pipelines.layout, [view, state, ...four, starts]));
    [this.keys, this.order] = [keys, order];
  }

  run(pass: GPUComputePassEncoder): void {
    const tiles = Math.ceil(this.count / TILE);
    this.pipelines.digits.forEach(({ count, scan, scatter }, digit) => {
      const group = this.groups[digit];
      dispatch(pass, count, group, tiles);
      dispatch(pass, scan, group, 1);
      dispatch(pass, scatter, group, tiles);
    });
  }
}
