// The network of features.ts on the GPU: one pixel of a float texture for each Gaussian, with its first colour
// coefficients and its opacity.

import type { FeatureChanges, MeshBound } from "./avatar";
import { ownPart, sizesOf } from "./features";
import { Program } from "./program";
import { layoutOf } from "./rig";
import { FEATURE_WIDTH, SCREEN_VERTEX, TEXTURE_WIDTH, featureFragment } from "./shaders";

/** Rows of `width` numbers in rows of whole texels. */
function padded(from: Float32Array, width: number): Float32Array {
  const to = 4 * Math.ceil(width / 4), rows = from.length / width;
  if (to === width) return from;
  const out = new Float32Array(rows * to);
  for (let row = 0; row < rows; ++row) out.set(from.subarray(row * width, (row + 1) * width), row * to);
  return out;
}

/** The share of each region in the triangle of each Gaussian. */
function sharesOf({ face_index, changes }: MeshBound, regions: number): Float32Array {
  const shares = changes?.shares, out = new Float32Array(face_index.length * regions).fill(1);
  if (shares) face_index.forEach((face, i) => out.set(shares.subarray(face * regions, (face + 1) * regions), i * regions));
  return out;
}

/** Texels for a number of each region. */
const foursOf = ({ changes, faces }: MeshBound): number => Math.ceil(layoutOf(changes!, faces.length / 3).regions / 4);

export class FeaturePass {
  /** The result: a texture of TEXTURE_WIDTH texels a row. */
  readonly output: WebGLTexture;
  private readonly program: Program;
  private readonly frame: WebGLFramebuffer;
  private readonly inputs: [string, WebGLTexture][];

  /** Null where there are no features, or a device cannot draw into float textures, or holds too little. */
  static on(gl: WebGL2RenderingContext, baked: MeshBound | null): FeaturePass | null {
    const features = baked?.changes?.features;
    if (!features) return null;
    const count = baked.face_index.length, { width, rank } = sizesOf(features, count), texels = Math.ceil(width / 4);
    const rows = Math.ceil((count * rank * texels) / FEATURE_WIDTH), fours = rank * foursOf(baked);
    const fits = rank > 0 && fours <= 128 && rows <= gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const draws = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
    return fits && draws ? new FeaturePass(gl, baked, features) : null;
  }

  private readonly count: number;
  private readonly regions: number;

  private constructor(private readonly gl: WebGL2RenderingContext, baked: MeshBound, features: FeatureChanges) {
    const count = baked.face_index.length, { regions } = layoutOf(baked.changes!, baked.faces.length / 3), fours = foursOf(baked);
    [this.count, this.regions] = [count, regions];
    const { width, rank, hidden } = sizesOf(features, count), texels = Math.ceil(width / 4), units = 4 * Math.ceil(hidden / 4);
    this.program = new Program(gl, SCREEN_VERTEX, featureFragment(texels, rank, units, fours));
    const { weights, biases } = features, columns = weights[0].length / hidden;
    // For each hidden unit: its weights of the features, then those of the four outputs.
    const table = new Float32Array(4 * (texels + 1) * units);
    for (let h = 0; h < hidden; ++h) {
      const row = 4 * (texels + 1) * h;
      table.set(weights[0].subarray(h * columns, h * columns + width), row);
      for (let o = 0; o < 4; ++o) table[row + 4 * texels + o] = weights[1][o * hidden + h];
    }
    this.inputs = [
      ["u_neutral", this.texture(padded(features.neutral, width), gl.RGBA16F)],
      ["u_basis", this.texture(padded(features.basis, width), gl.RGBA16F)],
      ["u_own", this.texture(padded(ownPart(features, count, width), hidden), gl.RGBA16F)],
      ["u_weights", this.texture(table, gl.RGBA32F)],
      ["u_shares", this.texture(padded(sharesOf(baked, regions), regions), gl.RGBA16F)],
    ];
    this.program.use();
    gl.uniform4fv(this.program.uniform("u_bias"), biases[1]);
    gl.uniform1i(this.program.uniform("u_count"), count);
    this.output = gl.createTexture()!;
    this.frame = gl.createFramebuffer()!;
    gl.bindTexture(gl.TEXTURE_2D, this.output);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, TEXTURE_WIDTH, this.rows);
    this.nearest();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.output, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  /** Computes the output. `rest` binds the texture with first colour coefficients and raw opacities to a unit. */
  run(rest: (unit: number) => void, activations: ArrayLike<number>): void {
    const { gl, program } = this;
    program.use();
    rest(0);
    gl.uniform1i(program.uniform("u_rest"), 0);
    this.inputs.forEach(([name, texture], index) => {
      gl.activeTexture(gl.TEXTURE1 + index);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(program.uniform(name), 1 + index);
    });
    // For each activation, those of all regions.
    const width = activations.length / this.regions, row = 4 * Math.ceil(this.regions / 4), sent = new Float32Array(width * row);
    for (let i = 0; i < activations.length; ++i) sent[(i % width) * row + Math.floor(i / width)] = activations[i];
    gl.uniform4fv(program.uniform("u_activations"), sent);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, TEXTURE_WIDTH, this.rows);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  private get rows(): number {
    return Math.max(1, Math.ceil(this.count / TEXTURE_WIDTH));
  }

  private texture(values: Float32Array, format: GLenum): WebGLTexture {
    const { gl } = this, rows = Math.max(1, Math.ceil(values.length / 4 / FEATURE_WIDTH)), texture = gl.createTexture()!;
    const whole = new Float32Array(4 * FEATURE_WIDTH * rows);
    whole.set(values);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, FEATURE_WIDTH, rows);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, FEATURE_WIDTH, rows, gl.RGBA, gl.FLOAT, whole);
    this.nearest();
    return texture;
  }

  private nearest(): void {
    const { gl } = this;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }
}
