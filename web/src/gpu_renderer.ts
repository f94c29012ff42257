// Draws posed Gaussians with WebGPU: compute passes project and sort them, then one quad each is blended into half floats.

import type { Avatar } from "./avatar";
import { dispatch, Memory } from "./gpu_memory";
import { GpuPoser, type Posed } from "./gpu_pose";
import { DRAW, PROJECT, SCREEN, THREADS } from "./gpu_shaders";
import { GpuSorter, SortPipelines } from "./gpu_sort";
import type { PointPoser } from "./points";
import { spread, type Color, type Drawer, type View } from "./renderer";
import type { Poser } from "./rig";

// TypeScript has the types of WebGPU, but not this.
declare const GPUTextureUsage: Record<"RENDER_ATTACHMENT" | "TEXTURE_BINDING", number>;

const PICTURE: GPUTextureFormat = "rgba16float";
/** Numbers of the structure `View` of the shaders. */
const VIEW_SIZE = 36;
/** Before a picture: no range of depths, and the arguments of a draw of four corners. */
const EMPTY_STATE = Uint32Array.of(0xffffffff, 0, 4, 0, 0, 0);
const VISIBLE_AT = 8;

/** What a device has compiled. It serves any number of avatars. */
export class Pipelines {
  readonly project: GPUComputePipeline;
  readonly sort: SortPipelines;
  readonly draw: GPURenderPipeline;
  readonly screen: GPURenderPipeline;

  constructor(readonly device: GPUDevice, readonly format: GPUTextureFormat) {
    const compiled = (code: string) => device.createShaderModule({ code });
    this.project = device.createComputePipeline({ layout: "auto", compute: { module: compiled(PROJECT) } });
    this.sort = new SortPipelines(device);
    const over: GPUBlendComponent = { srcFactor: "one", dstFactor: "one-minus-src-alpha" };
    const drawing = (code: string, target: GPUColorTargetState, topology: GPUPrimitiveTopology) => {
      const module = compiled(code);
      return device.createRenderPipeline({ layout: "auto", vertex: { module }, fragment: { module, targets: [target] }, primitive: { topology } });
    };
    this.draw = drawing(DRAW, { format: PICTURE, blend: { color: over, alpha: over } }, "triangle-strip");
    this.screen = drawing(SCREEN, { format }, "triangle-list");
  }
}

export class GpuRenderer implements Drawer {
  private readonly memory: Memory;
  private readonly posed: Posed;
  private readonly shapes: GPUBuffer;
  private readonly view: GPUBuffer;
  private readonly state: GPUBuffer;
  /** Null for Gaussians that the CPU poses. */
  private readonly gpuPoser: GpuPoser | null;
  private readonly sorter: GpuSorter;
  /** Numbers of `means`, `colours` and `shapes`. */
  private readonly means: Float32Array;
  private readonly colors: Float32Array;
  private readonly shapeValues: Float32Array;
  private readonly project: GPUBindGroup;
  private readonly splats: GPUBindGroup;
  private readonly count: number;
  private readonly shRest: number;
  private picture: GPUTexture | null = null;
  private screen: GPUBindGroup | null = null;

  constructor(private readonly pipelines: Pipelines, private readonly context: GPUCanvasContext, avatar: Avatar, private readonly poser: Poser) {
    const { device } = pipelines, { attributes } = avatar.baked, { bound, faceIndex } = poser, memory = (this.memory = new Memory(device));
    const count = (this.count = faceIndex.length);
    this.shRest = attributes.sh.length / 3 / Math.max(count, 1) - 1;
    [this.means, this.colors, this.shapeValues] = [4, 4, 8].map((width) => new Float32Array(width * count));
    faceIndex.forEach((face, i) => (this.means[4 * i + 3] = face));
    spread(poser.means, this.means);
    for (let i = 0; i < count; ++i) {
      const at = 3 * i * (1 + this.shRest);
      this.colors.set([...attributes.sh.subarray(at, at + 3), attributes.opacity_logits[i]], 4 * i);
    }
    const rest = new Float32Array(4 * count * this.shRest);
    for (let i = 0; i < count * this.shRest; ++i) {
      const from = 3 * (i + Math.floor(i / this.shRest) + 1);
      rest.set(attributes.sh.subarray(from, from + 3), 4 * i);
    }
    const posed = (this.posed = { frames: memory.storage(poser.frames.length), means: memory.storage(this.means), colors: memory.storage(this.colors) });
    this.shapes = memory.storage(8 * count);
    this.view = memory.uniform(VIEW_SIZE);
    this.state = memory.indirect(EMPTY_STATE);
    this.sorter = new GpuSorter(pipelines.sort, memory, count, this.view, this.state);
    const splats = memory.storage(12 * count), sorted = this.sorter;
    const inputs = [posed.frames, posed.means, this.shapes, posed.colors, memory.storage(rest)];
    this.project = memory.group(pipelines.project.getBindGroupLayout(0), [this.view, ...inputs, splats, sorted.keys, this.state]);
    this.splats = memory.group(pipelines.draw.getBindGroupLayout(0), [this.view, splats, sorted.order]);
    this.uploadShapes(attributes.quats, attributes.log_scales.map(Math.exp));
    this.gpuPoser = bound && new GpuPoser(memory, bound, posed, this.means, this.colors);
    context.configure({ device, format: pipelines.format, alphaMode: "premultiplied" });
  }

  /** Takes over what the poser has computed for a new face, and poses the rest. */
  upload(): void {
    const { gpuPoser, poser } = this;
    gpuPoser?.run(poser);
    if (poser.free) this.uploadPosed(poser, poser.free);
  }

  /** Draws the Gaussians over a background. The order is the GPU's own. */
  draw(_order: () => Uint32Array, view: View, background: Color): void {
    const { pipelines, count } = this, { device } = pipelines, [red, green, blue, alpha] = background, d = view.directions;
    const told = new Float32Array(VIEW_SIZE);
    told.set(view.head);
    told.set([d[0], d[1], d[2], 0, d[3], d[4], d[5], 0, d[6], d[7], d[8]], 12);
    told.set([...view.focal, ...view.centre, view.width, view.height], 24);
    new Uint32Array(told.buffer).set([count, this.shRest], 30);
    told.set([red * alpha, green * alpha, blue * alpha, alpha], 32);
    this.memory.write(this.view, told);
    this.memory.write(this.state, EMPTY_STATE);
    const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
    dispatch(pass, pipelines.project, this.project, Math.ceil(count / THREADS));
    this.sorter.run(pass);
    pass.end();
    const picture = this.pictureOf(view.width, view.height);
    this.render(encoder, picture.createView(), pipelines.draw, this.splats, (to) => to.drawIndirect(this.state, VISIBLE_AT));
    this.render(encoder, this.context.getCurrentTexture().createView(), pipelines.screen, this.screen!, (to) => to.draw(3));
    device.queue.submit([encoder.finish()]);
  }

  /** Frees the memory of the avatar. */
  dispose(): void {
    this.picture?.destroy();
    this.memory.free();
  }

  private render(encoder: GPUCommandEncoder, view: GPUTextureView, pipeline: GPURenderPipeline, group: GPUBindGroup, draw: (pass: GPURenderPassEncoder) => void) {
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, group);
    draw(pass);
    pass.end();
  }

  private pictureOf(width: number, height: number): GPUTexture {
    const { pipelines } = this, { device } = pipelines;
    if (this.picture?.width === width && this.picture.height === height) return this.picture;
    this.picture?.destroy();
    const { RENDER_ATTACHMENT, TEXTURE_BINDING } = GPUTextureUsage;
    const picture = (this.picture = device.createTexture({ size: [width, height], format: PICTURE, usage: RENDER_ATTACHMENT | TEXTURE_BINDING }));
    this.screen = device.createBindGroup({
      layout: pipelines.screen.getBindGroupLayout(0),
      entries: [{ binding: 0, resource: { buffer: this.view } }, { binding: 1, resource: picture.createView() }],
    });
    return picture;
  }

  private uploadPosed(poser: Poser, free: PointPoser): void {
    const { memory, posed, means, colors } = this;
    spread(poser.means, means);
    spread(poser.colors, colors);
    poser.opacityLogits.forEach((logit, i) => (colors[4 * i + 3] = logit));
    memory.write(posed.frames, poser.frames);
    memory.write(posed.means, means);
    memory.write(posed.colors, colors);
    this.uploadShapes(free.quats, free.scales);
  }

  private uploadShapes(quats: Float32Array, scales: Float32Array): void {
    const { shapeValues } = this;
    for (let i = 0; i < this.count; ++i) {
      for (let k = 0; k < 4; ++k) shapeValues[8 * i + k] = quats[4 * i + k];
      for (let k = 0; k < 3; ++k) shapeValues[8 * i + 4 + k] = scales[3 * i + k];
    }
    this.memory.write(this.shapes, shapeValues);
  }
}
