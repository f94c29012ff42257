// A counting sort of depths.

const KEYS = 1 << 16;

/** Sorts n Gaussians from far to near. Equal keys (1/65536 of the range of depths) keep their order. */
export class DepthSorter {
  /** Indices of the Gaussians, farthest first, after `sort`. */
  readonly order: Uint32Array;
  private readonly keys: Uint16Array;
  private readonly starts = new Uint32Array(KEYS);

  constructor(count: number) {
    this.order = new Uint32Array(count);
    this.keys = new Uint16Array(count);
  }

  sort(depths: Float32Array): Uint32Array {
    const { order, keys, starts } = this, count = depths.length;
    let near = Infinity, far = -Infinity;
    for (let i = 0; i < count; ++i) {
      const depth = depths[i];
      if (depth < near) near = depth;
      if (depth > far) far = depth;
    }
    const scale = far > near ? (KEYS - 1) / (far - near) : 0;
    starts.fill(0);
    for (let i = 0; i < count; ++i) ++starts[(keys[i] = ((far - depths[i]) * scale) | 0)];
    for (let key = 0, sum = 0; key < KEYS; ++key) {
      const here = starts[key];
      starts[key] = sum;
      sum += here;
    }
    for (let i = 0; i < count; ++i) order[starts[keys[i]]++] = i;
    return order;
  }
}
