// Buffers of one avatar on a WebGPU device.

import { AvatarError } from "./format";

// TypeScript has the types of WebGPU, but not this.
declare const GPUBufferUsage: Record<"COPY_SRC" | "COPY_DST" | "STORAGE" | "UNIFORM" | "INDIRECT", number>;

type Numbers = Float32Array | Uint32Array | Int32Array;

export class Memory {
  private readonly buffers: GPUBuffer[] = [];

  constructor(readonly device: GPUDevice) {}

  /** A storage buffer of so many numbers, or with these numbers. It can be read back. */
  storage(content: number | Numbers, usage = 0): GPUBuffer {
    const { STORAGE, COPY_SRC } = GPUBufferUsage, { maxStorageBufferBindingSize, maxBufferSize } = this.device.limits;
    const bytes = 4 * (typeof content === "number" ? content : content.length);
    if (bytes > Math.min(maxStorageBufferBindingSize, maxBufferSize)) throw new AvatarError("has more Gaussians than this device can hold");
    const buffer = this.buffer(bytes, STORAGE | COPY_SRC | usage);
    if (typeof content !== "number") this.write(buffer, content);
    return buffer;
  }

  /** A storage buffer that also holds the arguments of a draw. */
  indirect(content: Numbers): GPUBuffer {
    return this.storage(content, GPUBufferUsage.INDIRECT);
  }

  /** A uniform buffer of so many numbers. */
  uniform(size: number): GPUBuffer {
    return this.buffer(4 * size, GPUBufferUsage.UNIFORM);
  }

  write(buffer: GPUBuffer, values: Numbers): void {
    this.device.queue.writeBuffer(buffer, 0, values as Float32Array<ArrayBuffer>);
  }

  /** Buffers at the bindings 0, 1, 2... */
  group(layout: GPUBindGroupLayout, buffers: GPUBuffer[]): GPUBindGroup {
    return this.device.createBindGroup({ layout, entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })) });
  }

  free(): void {
    for (const buffer of this.buffers) buffer.destroy();
  }

  private buffer(bytes: number, usage: GPUBufferUsageFlags): GPUBuffer {
    // Even an empty array needs room for one element.
    const buffer = this.device.createBuffer({ size: Math.max(64, bytes), usage: usage | GPUBufferUsage.COPY_DST });
    this.buffers.push(buffer);
    return buffer;
  }
}

/** Runs a compute pipeline for so many workgroups. */
export function dispatch(pass: GPUComputePassEncoder, pipeline: GPUComputePipeline, group: GPUBindGroup, workgroups: number): void {
  pass.setPipeline(pipeline);
  pass.setBindGroup(0, group);
  pass.dispatchWorkgroups(workgroups);
}
