// Draws posed Gaussians with WebGPU: compute passes project and sort them, then one quad each is blended into half floats.

import type { Avatar } from "./avatar";
import { AvatarError } from "./format";
import { DRAW, PROJECT, SCREEN, SORT, THREADS, TILE } from "./gpu_shaders";
import { spread, type Colour, type Drawer, type View } from "./renderer";
import type { Poser } from "./rig";
import type { SkinnedPoser } from "./skinned";

// TypeScript has the types of WebGPU, but not these.
declare const GPUBufferUsage: Record<"COPY_DST" | "STORAGE" | "UNIFORM" | "INDIRECT", number>;
declare const GPUTextureUsage: Record<"RENDER_ATTACHMENT" | "TEXTURE_BINDING", number>;
declare const GPUShaderStage: { COMPUTE: number };

const PICTURE: GPUTextureFormat = "rgba16float";
/** Numbers of the structure `View` of the shaders. */
const VIEW_SIZE = 36;
/** Before a picture: no range of depths, and the arguments of a draw of four corners. */
const EMPTY_STATE = Uint32Array.of(0xffffffff, 0, 4, 0, 0, 0);
const VISIBLE_AT = 8;

/** What a device has compiled. It serves any number of avatars. */
export class Pipelines {
  readonly project: GPUComputePipeline;
  /** Both passes of the sort have these three; their bind groups have one layout. */
  readonly sort: { count: GPUComputePipeline; scan: GPUComputePipeline; scatter: GPUComputePipeline }[];
  readonly sortLayout: GPUBindGroupLayout;
  readonly draw: GPURenderPipeline;
  readonly screen: GPURenderPipeline;

  constructor(readonly device: GPUDevice, readonly format: GPUTextureFormat) {
    const compiled = (code: string) => device.createShaderModule({ code });
    this.project = device.createComputePipeline({ layout: "auto", compute: { module: compiled(PROJECT) } });
    const types: GPUBufferBindingType[] = ["uniform", ...Array(3).fill("read-only-storage"), ...Array(3).fill("storage")];
    this.sortLayout = device.createBindGroupLayout({
      entries: types.map((type, binding) => ({ binding, visibility: GPUShaderStage.COMPUTE, buffer: { type } })),
    });
    const layout = device.createPipelineLayout({ bindGroupLayouts: [this.sortLayout] }), sort = compiled(SORT);
    this.sort = [1, 0].map((FIRST) => {
      const of = (entryPoint: string) => device.createComputePipeline({ layout, compute: { module: sort, entryPoint, constants: { FIRST } } });
      return { count: of("count"), scan: of("scan"), scatter: of("scatter") };
    });
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
  private readonly device: GPUDevice;
  private readonly buffers: GPUBuffer[] = [];
  private readonly count: number;
  private readonly shRest: number;
  private readonly frames: GPUBuffer;
  private readonly means: GPUBuffer;
  private readonly shapes: GPUBuffer;
  private readonly colours: GPUBuffer;
  private readonly view: GPUBuffer;
  private readonly state: GPUBuffer;
  /** Numbers of `means`, `shapes` and `colours`. */
  private readonly meanValues: Float32Array<ArrayBuffer>;
  private readonly shapeValues: Float32Array<ArrayBuffer>;
  private readonly colourValues: Float32Array<ArrayBuffer>;
  private readonly groups: { project: GPUBindGroup; sort: GPUBindGroup[]; draw: GPUBindGroup };
  private picture: GPUTexture | null = null;
  private screen: GPUBindGroup | null = null;

  constructor(private readonly pipelines: Pipelines, private readonly context: GPUCanvasContext, avatar: Avatar, private readonly poser: Poser) {
    const { device } = pipelines, { attributes, faces, face_index } = avatar.baked, { STORAGE, UNIFORM, INDIRECT } = GPUBufferUsage;
    this.device = device;
    const count = (this.count = face_index.length);
    this.shRest = attributes.sh.length / 3 / Math.max(count, 1) - 1;
    [this.frames, this.means, this.shapes, this.colours] = [4 * faces.length, 4 * count, 8 * count, 4 * count].map((size) => this.buffer(size, STORAGE));
    const sh = this.buffer(4 * count * this.shRest, STORAGE), splats = this.buffer(12 * count, STORAGE);
    const [keys, order, otherKeys, otherOrder] = Array.from({ length: 4 }, () => this.buffer(count, STORAGE));
    const starts = this.buffer(256 * Math.ceil(count / TILE), STORAGE);
    this.view = this.buffer(VIEW_SIZE, UNIFORM);
    this.state = this.buffer(EMPTY_STATE.length, STORAGE | INDIRECT);
    this.meanValues = new Float32Array(4 * count);
    this.shapeValues = new Float32Array(8 * count);
    this.colourValues = new Float32Array(4 * count);
    face_index.forEach((face, i) => (this.meanValues[4 * i + 3] = face));
    const rest = new Float32Array(4 * count * this.shRest);
    for (let i = 0; i < count * this.shRest; ++i) {
      const from = 3 * (i + Math.floor(i / this.shRest) + 1);
      rest.set(attributes.sh.subarray(from, from + 3), 4 * i);
    }
    this.write(sh, rest);
    this.uploadShapes(attributes.quats, attributes.log_scales.map(Math.exp));
    this.uploadChanged();
    const { view, state } = this, { project, sortLayout, draw } = pipelines;
    this.groups = {
      project: this.group(project.getBindGroupLayout(0), [view, this.frames, this.means, this.shapes, this.colours, sh, splats, keys, state]),
      sort: [[keys, order, otherKeys, otherOrder], [otherKeys, otherOrder, keys, order]].map((four) => this.group(sortLayout, [view, state, ...four, starts])),
      draw: this.group(draw.getBindGroupLayout(0), [view, splats, order]),
    };
    context.configure({ device, format: pipelines.format, alphaMode: "premultiplied" });
  }

  /** Takes over what the poser has computed for a new face. */
  upload(): void {
    this.write(this.frames, this.poser.frames);
    if (this.poser.changed) this.uploadChanged();
  }

  /** Draws the Gaussians over a background. The order is the GPU's own. */
  draw(_order: () => Uint32Array, view: View, background: Colour): void {
    const { device, pipelines, groups, count } = this, [red, green, blue, alpha] = background, d = view.directions;
    const told = new Float32Array(VIEW_SIZE);
    told.set(view.head);
    told.set([d[0], d[1], d[2], 0, d[3], d[4], d[5], 0, d[6], d[7], d[8]], 12);
    told.set([...view.focal, ...view.centre, view.width, view.height], 24);
    new Uint32Array(told.buffer).set([count, this.shRest], 30);
    told.set([red * alpha, green * alpha, blue * alpha, alpha], 32);
    this.write(this.view, told);
    this.write(this.state, EMPTY_STATE);
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    const run = (pipeline: GPUComputePipeline, group: GPUBindGroup, workgroups: number) => {
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, group);
      pass.dispatchWorkgroups(workgroups);
    };
    run(pipelines.project, groups.project, Math.ceil(count / THREADS));
    pipelines.sort.forEach((sort, digit) => {
      run(sort.count, groups.sort[digit], Math.ceil(count / TILE));
      run(sort.scan, groups.sort[digit], 1);
      run(sort.scatter, groups.sort[digit], Math.ceil(count / TILE));
    });
    pass.end();
    const picture = this.pictureOf(view.width, view.height);
    this.render(encoder, picture.createView(), pipelines.draw, groups.draw, (to) => to.drawIndirect(this.state, VISIBLE_AT));
    this.render(encoder, this.context.getCurrentTexture().createView(), pipelines.screen, this.screen!, (to) => to.draw(3));
    device.queue.submit([encoder.finish()]);
  }

  /** Frees the memory of the avatar. */
  dispose(): void {
    this.picture?.destroy();
    for (const buffer of this.buffers) buffer.destroy();
  }

  private render(encoder: GPUCommandEncoder, view: GPUTextureView, pipeline: GPURenderPipeline, group: GPUBindGroup, draw: (pass: GPURenderPassEncoder) => void) {
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, group);
    draw(pass);
    pass.end();
  }

  private pictureOf(width: number, height: number): GPUTexture {
    const { device, pipelines } = this;
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

  private uploadChanged(): void {
    const { poser, meanValues, colourValues } = this;
    spread(poser.means, meanValues);
    spread(poser.colours, colourValues);
    poser.opacityLogits.forEach((logit, i) => (colourValues[4 * i + 3] = 1 / (1 + Math.exp(-logit))));
    this.write(this.means, meanValues);
    this.write(this.colours, colourValues);
    const posed: SkinnedPoser | null = poser.skinned;
    if (posed) this.uploadShapes(posed.quats, posed.scales);
  }

  private uploadShapes(quats: Float32Array, scales: Float32Array): void {
    const { shapeValues } = this;
    for (let i = 0; i < this.count; ++i) {
      for (let k = 0; k < 4; ++k) shapeValues[8 * i + k] = quats[4 * i + k];
      for (let k = 0; k < 3; ++k) shapeValues[8 * i + 4 + k] = scales[3 * i + k];
    }
    this.write(this.shapes, shapeValues);
  }

  /** A buffer of so many numbers. */
  private buffer(size: number, usage: GPUBufferUsageFlags): GPUBuffer {
    const bytes = Math.max(16, 4 * size);
    if (bytes > this.device.limits.maxStorageBufferBindingSize) throw new AvatarError("has more Gaussians than this device can hold");
    const buffer = this.device.createBuffer({ size: bytes, usage: usage | GPUBufferUsage.COPY_DST });
    this.buffers.push(buffer);
    return buffer;
  }

  private write(buffer: GPUBuffer, values: Float32Array | Uint32Array): void {
    this.device.queue.writeBuffer(buffer, 0, values as Float32Array<ArrayBuffer>);
  }

  private group(layout: GPUBindGroupLayout, buffers: GPUBuffer[]): GPUBindGroup {
    return this.device.createBindGroup({ layout, entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })) });
  }
}
