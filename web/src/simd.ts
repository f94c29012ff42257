// Posing of bound Gaussians by WebAssembly, with vectors of four numbers: wasm/posing.ts. Bases of features have 8 bits there,
// so that a pose reads a fourth of the memory.

import module from "./posing.wasm";
import type { FeatureChanges, MeshBound } from "./avatar";
import { ownPart, sizesOf } from "./features";
import { layoutOf, type Poser } from "./rig";

type Part = Float32Array | Int32Array | Int8Array;
/** What the module exports: globals and functions. */
type Program = { [name: string]: WebAssembly.Global & (() => void) };

/** Numbers of a row of each result. */
const RESULTS = { centres: 3, covariances: 6, rotations: 4, scales: 3, colors: 4 };
export type Result = keyof typeof RESULTS;

const upTo = (size: number, whole: number): number => Math.ceil(size / whole) * whole;

/** Rows of `width` numbers as rows of `to`; the rest are `fill`. */
function widened(from: ArrayLike<number>, width: number, to: number, rows: number, fill = 0): Float32Array {
  const out = new Float32Array(rows * to).fill(fill);
  for (let row = 0; row < rows && row * width < from.length; ++row) for (let k = 0; k < width; ++k) out[row * to + k] = from[row * width + k];
  return out;
}

/** Bases [n, parts, rank] as [n, rank, 4]; the parts of several bases go side by side. */
function besides(bases: (Float32Array | null)[], count: number, rows: number): { rank: number; values: Float32Array } {
  const parts = bases.map((_, b) => (b ? 1 : 3)), rank = Math.max(0, ...bases.map((one, b) => (one ? one.length / count / parts[b] : 0)));
  const values = new Float32Array(4 * rows * rank);
  bases.forEach((basis, b) => {
    for (let i = 0, at = 0; basis && i < count; ++i)
      for (let part = 0; part < parts[b]; ++part) for (let k = 0; k < rank; ++k) values[4 * (i * rank + k) + 3 * b + part] = basis[at++];
  });
  return { rank, values };
}

/** Bases [n, rank, w] as integers of 8 bits [n, width / 2, features, 2], and the step of each Gaussian. */
function coarseBases(basis: Float32Array, { count, rank, w, width, features, rows }: { [name: string]: number }): { integers: Int8Array; steps: Float32Array } {
  const integers = new Int8Array(rows * width * features), steps = new Float32Array(rows);
  for (let i = 0; i < count; ++i) {
    let most = 0;
    for (let k = i * rank * w; k < (i + 1) * rank * w; ++k) most = Math.max(most, Math.abs(basis[k]));
    steps[i] = most / 127;
    for (let k = 0; most && k < rank; ++k)
      for (let f = 0; f < w; ++f) integers[i * width * features + ((k >> 1) * features + f) * 2 + (k & 1)] = Math.round((basis[(i * rank + k) * w + f] * 127) / most);
  }
  return { integers, steps };
}

/** The network in the module's form. */
function networkOf(network: FeatureChanges, count: number, width: number, rows: number): { parts: { [name: string]: Part }; sizes: { [name: string]: number } } {
  const { neutral, basis, weights, biases } = network, { width: w, rank, hidden: h } = sizesOf(network, count);
  const features = upTo(w, 16), hidden = upTo(h, 16), columns = weights[0].length / h;
  const first = new Float32Array(hidden * features), second = new Float32Array(4 * hidden), bias = new Float32Array(4 + hidden);
  for (let u = 0; u < h; ++u) {
    const group = u >> 4, unit = u & 15;
    for (let f = 0; f < w; ++f) first[(group * features + f) * 16 + unit] = weights[0][u * columns + f];
    for (let o = 0; o < 4; ++o) second[(group * 4 + o) * 16 + unit] = weights[1][o * h + u];
  }
  bias.set(biases[1]);
  bias.set(biases[0], 4);
  const { integers, steps } = coarseBases(basis, { count, rank, w, width, features, rows });
  const parts = { neutral: widened(neutral, w, features, rows), bases: integers, basisSteps: steps, first, second, bias, blended: new Float32Array(2 * features) };
  return { parts: columns > w ? { ...parts, own: widened(ownPart(network, count, w), h, hidden, rows) } : parts, sizes: { features, hidden } };
}

export class SimdPosing {
  /** The results, each a row for each Gaussian. */
  readonly results: Record<Result, Float32Array>;
  private readonly program: Program;
  private readonly views: { [name: string]: Float32Array } = {};
  private readonly width: number;
  private painted = false;

  /** Null where there is no WebAssembly with vectors, or a page's rules forbid it. */
  static on(poser: Poser, shapes: Record<"quats" | "scales" | "covariances", Float32Array>, least: number): SimdPosing | null {
    try {
      return poser.bound && new SimdPosing(poser.bound, poser, shapes, least);
    } catch (error) {
      if (error instanceof WebAssembly.CompileError || error instanceof ReferenceError) return null;
      throw error;
    }
  }

  private constructor(bound: MeshBound, poser: Poser, shapes: Record<"quats" | "scales" | "covariances", Float32Array>, least: number) {
    const compiled = new WebAssembly.Module(module);
    const { faces, face_index, changes, attributes, rig } = bound, count = face_index.length, rows = upTo(count, 4), triangles = faces.length / 3;
    const layout = changes ? layoutOf(changes, triangles) : { regions: 1, width: 0 }, width = (this.width = upTo(layout.width, 4)), { regions } = layout;
    const paint = new Float32Array(4 * rows), moves = besides([changes?.means ?? null], count, rows), paints = besides([changes?.color ?? null, changes?.opacity_logits ?? null], count, rows);
    for (let i = 0; i < count; ++i) paint.set([...poser.colors.subarray(3 * i, 3 * i + 3), attributes.opacity_logits[i]], 4 * i);
    const network = changes?.features ? networkOf(changes.features, count, width, rows) : { parts: { bias: new Float32Array(4) }, sizes: {} };
    const used = Int32Array.from(new Set(face_index)), index = new Int32Array(rows).fill(used[0] ?? 0);
    index.set(face_index);
    const parts: { [name: string]: Part } = {
      triangles: used, corners: faces, points: new Float32Array(rig.template.length), transform: new Float32Array(16),
      frames: new Float32Array(16 * triangles), turns: new Float32Array(4 * triangles), sizes: new Float32Array(triangles),
      activations: new Float32Array(regions * width), shares: changes?.shares ?? new Float32Array(triangles).fill(1),
      table: new Float32Array(triangles * width), coarse: new Float32Array((triangles * width) / 2), steps: new Float32Array(triangles), rows: index,
      means: widened(bound.means, 3, 4, rows), movements: moves.values, paint, paintings: paints.values,
      shapes: widened(shapes.covariances, 6, 6, rows), quats: widened(shapes.quats, 4, 4, rows), spreads: widened(shapes.scales, 3, 4, rows), ...network.parts,
      ...Object.fromEntries(Object.entries(RESULTS).map(([name, each]) => [name, new Float32Array(each * rows)])),
    };
    // Vectors of 16 bytes may reach beyond a part.
    const places = new Map<string, number>();
    let size = 64;
    for (const [name, { byteLength }] of Object.entries(parts)) {
      places.set(name, size);
      size = upTo(size + byteLength + 16, 64);
    }
    const memory = new WebAssembly.Memory({ initial: Math.ceil(size / 65536) });
    this.program = new WebAssembly.Instance(compiled, { env: { memory } }).exports as Program;
    for (const [name, at] of places) {
      const part = parts[name], view = new (part.constructor as Float32ArrayConstructor)(memory.buffer, at, part.length);
      view.set(part);
      this.views[name] = view;
      this.program[name].value = at;
    }
    const numbers = { count: rows, used: used.length, regions, width, moves: moves.rank, paints: paints.rank, least, ...network.sizes };
    for (const [name, value] of Object.entries(numbers)) this.program[name].value = value;
    this.results = Object.fromEntries(Object.entries(RESULTS).map(([name, each]) => [name, this.views[name].subarray(0, each * count)])) as Record<Result, Float32Array>;
  }

  /** Poses Gaussians into those results that are asked for, by what a poser found of the face. */
  pose({ points, activations, changed }: Poser, transform: ArrayLike<number>, asked: (name: Result) => boolean): void {
    const { program, views, width } = this;
    views.points.set(points);
    views.transform.set(transform);
    program.placeFrames();
    if (width && (changed || !this.painted)) {
      const regions = views.activations.length / width, each = activations.length / regions;
      views.activations.set(widened(activations, each, width, regions));
      program.shareActivations();
    }
    if (changed || !this.painted) program.color();
    this.painted = true;
    program.placeCentres();
    if (asked("covariances")) program.placeCovariances();
    if (asked("rotations") || asked("scales")) program.turnFrames();
    if (asked("rotations")) program.placeRotations();
    if (asked("scales")) program.placeScales();
  }
}
