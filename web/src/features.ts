// Colours and opacities of features that the face blends, through a network of two layers: on the CPU. It follows
// mien.runtime.posing.feature_changes.

import type { FeatureChanges } from "./avatar";

/** Slope of the hidden layer below zero. */
export const SLOPE = 0.01;

/** Activations of the face: the row of each Gaussian in a table of rows of `width` numbers. */
export interface Activations {
  table: ArrayLike<number>;
  rows: Int32Array; // [n]
  width: number;
}

/** The sizes of a network: features, a Gaussian's activations, hidden units. */
export function sizesOf({ neutral, basis, biases }: FeatureChanges, count: number): { width: number; rank: number; hidden: number } {
  const width = neutral.length / Math.max(count, 1);
  return { width, rank: basis.length / Math.max(neutral.length, 1), hidden: biases[0].length };
}

/** What the hidden layer gets from each Gaussian alone [n, hidden]: its own inputs and the bias. */
export function ownPart({ own, weights, biases }: FeatureChanges, count: number, width: number): Float32Array {
  const hidden = biases[0].length, inputs = own.length / Math.max(count, 1), out = new Float32Array(count * hidden);
  for (let i = 0; i < count; ++i)
    for (let h = 0; h < hidden; ++h) {
      let sum = biases[0][h];
      for (let k = 0, w = h * (width + inputs) + width; k < inputs; ++k) sum += weights[0][w + k] * own[i * inputs + k];
      out[i * hidden + h] = sum;
    }
  return out;
}

export class FeatureNetwork {
  private readonly own: Float32Array;
  private readonly width: number;
  private readonly rank: number;
  private readonly hidden: number;
  /** Weights of the features in the hidden layer [hidden, width]. */
  private readonly first: Float32Array;

  constructor(private readonly features: FeatureChanges, private readonly count: number) {
    const { width, rank, hidden } = sizesOf(features, count);
    [this.width, this.rank, this.hidden] = [width, rank, hidden];
    this.own = ownPart(features, count, width);
    const columns = features.weights[0].length / hidden;
    this.first = new Float32Array(hidden * width);
    for (let h = 0; h < hidden; ++h) this.first.set(features.weights[0].subarray(h * columns, h * columns + width), h * width);
  }

  /** Adds the changes at these activations to first colour coefficients [n, 3] and raw opacities [n]. */
  add({ table, rows }: Activations, colors: Float32Array, opacityLogits: Float32Array): void {
    const { count, width, rank, hidden, first, own } = this, { neutral, basis, weights, biases } = this.features;
    const second = weights[1], bias = biases[1], blended = new Float32Array(width);
    for (let i = 0; i < count; ++i) {
      for (let f = 0; f < width; ++f) blended[f] = neutral[i * width + f];
      for (let k = 0, b = i * rank * width; k < rank; ++k, b += width) {
        const a = table[rows[i] * rank + k];
        if (a !== 0) for (let f = 0; f < width; ++f) blended[f] += a * basis[b + f];
      }
      let red = bias[0], green = bias[1], blue = bias[2], opacity = bias[3];
      for (let h = 0, w = 0, o = i * hidden; h < hidden; ++h, w += width) {
        let sum = own[o + h];
        for (let f = 0; f < width; ++f) sum += first[w + f] * blended[f];
        if (sum < 0) sum *= SLOPE;
        red += second[h] * sum;
        green += second[hidden + h] * sum;
        blue += second[2 * hidden + h] * sum;
        opacity += second[3 * hidden + h] * sum;
      }
      colors[3 * i] += red;
      colors[3 * i + 1] += green;
      colors[3 * i + 2] += blue;
      opacityLogits[i] += opacity;
    }
  }
}
