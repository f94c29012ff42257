// Draws posed Gaussians with WebGL2: one quad each, from far to near, blended into a picture of half floats.

import type { Avatar } from "./avatar";
import { FeaturePass } from "./feature_pass";
import { AvatarError } from "./format";
import { Program } from "./program";
import type { Poser } from "./rig";
import { SCREEN_FRAGMENT, SCREEN_VERTEX, SPLAT_FRAGMENT, SPLAT_VERTEX, TEXTURE_WIDTH } from "./shaders";

/** A view of the head frame. */
export interface View {
  /** Head to camera: the rows of [R | t]. */
  head: ArrayLike<number>;
  /** Head to the frame of view directions, row-major, for colours that depend on the view. */
  directions: ArrayLike<number>;
  /** Pixels. */
  focal: [number, number];
  centre: [number, number];
  width: number;
  height: number;
}

/** RGB and alpha, 0 to 1. */
export type Color = [number, number, number, number];

/** What draws the avatar of a viewer. */
export interface Drawer {
  /** Takes over what the poser has computed for a new face. */
  upload(): void;
  /** Draws over a background. `order` sorts the Gaussians, for those that cannot. */
  draw(order: () => Uint32Array, view: View, background: Color): void;
  dispose(): void;
}

/** Makes what draws on a canvas. It calls `change` when the face has to be posed and drawn again. */
export type Backend = (canvas: HTMLCanvasElement, avatar: Avatar, poser: Poser, change: () => void, WebGl2: typeof Renderer) => Drawer;

/** An array of float texels in a texture. */
class ArrayTexture {
  readonly values: Float32Array;
  private readonly texture: WebGLTexture;
  private readonly rows: number;

  constructor(private readonly gl: WebGL2RenderingContext, texels: number) {
    this.rows = Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));
    if (this.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new AvatarError("has more Gaussians than this device can hold");
    this.values = new Float32Array(4 * TEXTURE_WIDTH * this.rows);
    this.texture = gl.createTexture()!;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, TEXTURE_WIDTH, this.rows);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }

  upload(): void {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, this.rows, gl.RGBA, gl.FLOAT, this.values);
  }

  bind(unit: number): void {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(this.gl.TEXTURE_2D, this.texture);
  }
}

const ARRAYS = ["frames", "means", "quats", "scales", "colors", "sh"] as const;

/** The context of a canvas. The first call starts the GPU, which takes a while. */
export const contextOf = (canvas: HTMLCanvasElement | OffscreenCanvas): WebGL2RenderingContext | null =>
  (canvas as HTMLCanvasElement).getContext("webgl2", { antialias: false, depth: false, premultipliedAlpha: true, powerPreference: "high-performance" });

export class Renderer implements Drawer {
  private readonly gl: WebGL2RenderingContext;
  private readonly splats: Program;
  private readonly screen: Program;
  private readonly arrays: Record<(typeof ARRAYS)[number], ArrayTexture>;
  private readonly count: number;
  private readonly shRest: number;
  private readonly order: WebGLBuffer;
  private readonly attributes: WebGLVertexArrayObject;
  private readonly picture: Picture;
  private readonly features: FeaturePass | null;

  constructor(canvas: HTMLCanvasElement | OffscreenCanvas, avatar: Avatar, private readonly poser: Poser) {
    const gl = contextOf(canvas);
    if (!gl) throw new AvatarError("needs WebGL2, which this browser lacks or has switched off");
    this.gl = gl;
    const { attributes } = avatar.baked, { faceIndex } = poser;
    this.count = faceIndex.length;
    this.shRest = attributes.sh.length / 3 / Math.max(this.count, 1) - 1;
    this.splats = new Program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.screen = new Program(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    const of = (texels: number) => new ArrayTexture(gl, texels);
    this.arrays = {
      frames: of(poser.frames.length / 4), means: of(this.count), quats: of(this.count), scales: of(this.count),
      colors: of(this.count), sh: of(this.count * this.shRest),
    };
    const { means, sh } = this.arrays;
    this.uploadShapes(attributes.quats, attributes.log_scales.map(Math.exp));
    faceIndex.forEach((face, i) => (means.values[4 * i + 3] = face));
    for (let i = 0; i < this.count * this.shRest; ++i) {
      const from = 3 * (i + Math.floor(i / this.shRest) + 1);
      sh.values.set(attributes.sh.subarray(from, from + 3), 4 * i);
    }
    sh.upload();
    this.features = FeaturePass.on(gl, poser.bound);
    poser.runsNetwork = !this.features;
    this.uploadChanged();
    this.order = gl.createBuffer()!;
    this.attributes = gl.createVertexArray()!;
    gl.bindVertexArray(this.attributes);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * this.count, gl.DYNAMIC_DRAW);
    const index = gl.getAttribLocation(this.splats.program, "a_index");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
    gl.bindVertexArray(null);
    this.picture = new Picture(gl);
  }

  /** Takes over what the poser has computed for a new face. */
  upload(): void {
    this.arrays.frames.values.set(this.poser.frames);
    this.arrays.frames.upload();
    if (this.poser.changed) this.uploadChanged();
  }

  /** Draws the Gaussians in the given order over a background. */
  draw(order: () => Uint32Array, view: View, background: Color): void {
    const { gl, splats, screen } = this;
    this.picture.begin(view.width, view.height);
    splats.use();
    ARRAYS.forEach((name, unit) => {
      if (name === "colors" && this.features) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, this.features.output);
      } else this.arrays[name].bind(unit);
      gl.uniform1i(splats.uniform(`u_${name}`), unit);
    });
    gl.uniform4fv(splats.uniform("u_view"), Float32Array.from(view.head));
    gl.uniformMatrix3fv(splats.uniform("u_shFrame"), true, Float32Array.from(view.directions));
    gl.uniform2fv(splats.uniform("u_focal"), view.focal);
    gl.uniform2fv(splats.uniform("u_centre"), view.centre);
    gl.uniform2f(splats.uniform("u_size"), view.width, view.height);
    gl.uniform1i(splats.uniform("u_shRest"), this.shRest);
    gl.bindVertexArray(this.attributes);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order());
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
    this.picture.end();
    screen.use();
    gl.uniform1i(screen.uniform("u_picture"), 0);
    const [red, green, blue, alpha] = background;
    gl.uniform4f(screen.uniform("u_background"), red * alpha, green * alpha, blue * alpha, alpha);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Gives the context back. Browsers have few of them. */
  dispose(): void {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  private uploadShapes(quats: Float32Array, scales: Float32Array): void {
    const { arrays } = this;
    arrays.quats.values.set(quats);
    spread(scales, arrays.scales.values);
    arrays.quats.upload();
    arrays.scales.upload();
  }

  private uploadChanged(): void {
    const { means, colors } = this.arrays, { poser } = this;
    spread(poser.means, means.values);
    spread(poser.colors, colors.values);
    const { features } = this;
    poser.opacityLogits.forEach((logit, i) => (colors.values[4 * i + 3] = features ? logit : 1 / (1 + Math.exp(-logit))));
    means.upload();
    colors.upload();
    features?.run((unit) => colors.bind(unit), poser.activations);
    if (poser.free) this.uploadShapes(poser.free.quats, poser.free.scales);
  }
}

/** Rows of three into rows of four. The fourth number stays. */
export function spread(from: Float32Array, to: Float32Array): void {
  for (let i = 0, o = 0; i < from.length; i += 3, o += 4) {
    to[o] = from[i];
    to[o + 1] = from[i + 1];
    to[o + 2] = from[i + 2];
  }
}

/** The picture that Gaussians are blended into: half floats, or bytes where a device cannot blend those. */
class Picture {
  private readonly frame: WebGLFramebuffer;
  private readonly format: GLenum;
  private texture: WebGLTexture | null = null;
  private size = "";

  constructor(private readonly gl: WebGL2RenderingContext) {
    const floats = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
    this.format = floats ? gl.RGBA16F : gl.RGBA8;
    this.frame = gl.createFramebuffer()!;
  }

  begin(width: number, height: number): void {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    if (this.size !== `${width} ${height}`) {
      gl.deleteTexture(this.texture);
      this.texture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
      this.size = `${width} ${height}`;
    }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** Goes back to the canvas, with the picture as texture 0. */
  end(): void {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
  }
}
