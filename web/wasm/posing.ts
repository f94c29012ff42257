// Posing of bound Gaussians with vectors of four numbers, in AssemblyScript: build.mjs makes a module of WebAssembly of it. It
// follows triangleFrames of rig.ts, FeatureNetwork of features.ts and GaussianSource of gaussians.ts. src/simd.ts lays out the
// memory, and sets these addresses. A row of a triangle or a Gaussian begins at its number times the size of a row.

/** Gaussians, a multiple of 4, and the triangles that have any. */
export let count: i32;
export let used: i32;
/** Regions of the face, and activations of a Gaussian, a multiple of 4. */
export let regions: i32;
export let width: i32;
/** Features and hidden units of the network, multiples of 16. 0 features: there is no network. */
export let features: i32;
export let hidden: i32;
/** The smallest value of a colour. */
export let least: f32;
/** How many of the activations change centres, and how many change colours and opacities without a network. */
export let moves: i32;
export let paints: i32;
/** The numbers of used triangles, the corners of all [f, 3], and points [m, 3]. */
export let triangles: usize;
export let corners: usize;
export let points: usize;
/** The transform to the scene: four columns of 4. */
export let transform: usize;
/** Frames in the scene: four columns of 4 for each triangle; their rotations x y z w and their sizes. */
export let frames: usize;
export let turns: usize;
export let sizes: usize;
/** The face's activations [regions, width], shares [f, regions], and what both make: rows of floats, rows of 16 bits and their steps. */
export let activations: usize;
export let shares: usize;
export let table: usize;
export let coarse: usize;
export let steps: usize;
/** The triangle of each Gaussian. */
export let rows: usize;
/** Centres in frames [n, 4] and their changes [n, moves, 4]; first colour coefficients and raw opacity [n, 4] and their changes. */
export let means: usize;
export let movements: usize;
export let paint: usize;
export let paintings: usize;
/** Shapes in frames: covariances [n, 6], rotations [n, 4], standard deviations [n, 4]. */
export let shapes: usize;
export let quats: usize;
export let spreads: usize;
/** Neutral features [n, features]; bases of 8 bits [n, width / 2, features, 2], two activations side by side, and their steps [n]. */
export let neutral: usize;
export let bases: usize;
export let basisSteps: usize;
/** What the hidden layer gets from each Gaussian alone [n, hidden]; 0 where it is the same for all. */
export let own: usize;
/** Weights in groups of 16 hidden units: [hidden / 16, features, 16] and [hidden / 16, 4, 16]; biases of the outputs, then of hidden units. */
export let first: usize;
export let second: usize;
export let bias: usize;
/** Features of two Gaussians. */
export let blended: usize;
/** Results: centres [n, 3], covariances [n, 6], rotations [n, 4], scales [n, 3], colours with opacity [n, 4]. Four more bytes follow each. */
export let centres: usize;
export let covariances: usize;
export let rotations: usize;
export let scales: usize;
export let colors: usize;

/** Shortest first edge or height of a triangle that has a frame of its own, in metres. */
const DEGENERATE: f32 = 1e-7;
const SLOPE: f32 = 0.01;
const SH_C0: f32 = 0.28209479177387814;
/** The largest integer of 16 bits. */
const MOST: f32 = 32767;

@inline
function madd(a: v128, b: v128, c: v128): v128 {
  return f32x4.add(f32x4.mul(a, b), c);
}

@inline
function cross(a: v128, b: v128): v128 {
  const ay = v128.shuffle<f32>(a, a, 1, 2, 0, 3), az = v128.shuffle<f32>(a, a, 2, 0, 1, 3);
  const by = v128.shuffle<f32>(b, b, 1, 2, 0, 3), bz = v128.shuffle<f32>(b, b, 2, 0, 1, 3);
  return f32x4.sub(f32x4.mul(ay, bz), f32x4.mul(az, by));
}

@inline
function norm(a: v128): f32 {
  const s = f32x4.mul(a, a);
  return sqrt<f32>(f32x4.extract_lane(s, 0) + f32x4.extract_lane(s, 1) + f32x4.extract_lane(s, 2));
}

/** a x + b y + c z with the first three numbers of v. */
@inline
function turned(a: v128, b: v128, c: v128, v: v128): v128 {
  const x = v128.shuffle<f32>(v, v, 0, 0, 0, 0), y = v128.shuffle<f32>(v, v, 1, 1, 1, 1), z = v128.shuffle<f32>(v, v, 2, 2, 2, 2);
  return madd(c, z, madd(b, y, f32x4.mul(a, x)));
}

/** Frames of triangles in the scene. */
export function placeFrames(): void {
  const m0 = v128.load(transform), m1 = v128.load(transform, 16), m2 = v128.load(transform, 32), m3 = v128.load(transform, 48);
  for (let u = 0; u < used; ++u) {
    const t = load<i32>(triangles + (u << 2)), to = frames + (t << 6), from = corners + 12 * t;
    const a = v128.load(points + 12 * load<i32>(from)), b = v128.load(points + 12 * load<i32>(from, 4)), c = v128.load(points + 12 * load<i32>(from, 8));
    let e = f32x4.sub(b, a), s = f32x4.sub(c, a), edge = norm(e);
    if (edge < DEGENERATE || norm(cross(e, s)) < DEGENERATE * edge) {
      edge = DEGENERATE;
      e = f32x4(DEGENERATE, 0, 0, 0);
      s = f32x4(0, DEGENERATE, 0, 0);
    }
    e = f32x4.div(e, f32x4.splat(edge));
    let n = cross(e, s);
    const height = norm(n), k = f32x4.splat((edge + height) / 2), middle = f32x4.mul(f32x4.add(f32x4.add(a, b), c), f32x4.splat(1.0 / 3.0));
    n = f32x4.div(n, f32x4.splat(height));
    v128.store(to, f32x4.mul(k, turned(m0, m1, m2, e)));
    v128.store(to, f32x4.mul(k, turned(m0, m1, m2, n)), 16);
    v128.store(to, f32x4.mul(k, turned(m0, m1, m2, cross(e, n))), 32);
    v128.store(to, f32x4.add(m3, turned(m0, m1, m2, middle)), 48);
  }
}

/** Sizes of frames, and their rotations. */
export function turnFrames(): void {
  for (let u = 0; u < used; ++u) {
    const t = load<i32>(triangles + (u << 2)), from = frames + (t << 6), k = norm(v128.load(from));
    store<f32>(sizes + (t << 2), k);
    const xx = load<f32>(from) / k, yy = load<f32>(from, 20) / k, zz = load<f32>(from, 40) / k;
    const x = (load<f32>(from, 24) - load<f32>(from, 36)) / k, y = (load<f32>(from, 32) - load<f32>(from, 8)) / k, z = (load<f32>(from, 4) - load<f32>(from, 16)) / k;
    const xy = (load<f32>(from, 16) + load<f32>(from, 4)) / k, xz = (load<f32>(from, 32) + load<f32>(from, 8)) / k, yz = (load<f32>(from, 24) + load<f32>(from, 36)) / k;
    let q = f32x4(x, y, z, 1 + xx + yy + zz);
    if (xx + yy + zz < 0) {
      if (xx >= yy && xx >= zz) q = f32x4(1 + xx - yy - zz, xy, xz, x);
      else if (yy >= zz) q = f32x4(xy, 1 - xx + yy - zz, yz, y);
      else q = f32x4(xz, yz, 1 - xx - yy + zz, z);
    }
    const s = f32x4.mul(q, q), length = sqrt<f32>(f32x4.extract_lane(s, 0) + f32x4.extract_lane(s, 1) + f32x4.extract_lane(s, 2) + f32x4.extract_lane(s, 3));
    v128.store(turns + (t << 4), f32x4.div(q, f32x4.splat(length)));
  }
}

/** The activations of each used triangle, as its regions share it. */
export function shareActivations(): void {
  const size = width << 2;
  for (let u = 0; u < used; ++u) {
    const t = load<i32>(triangles + (u << 2)), to = table + t * size, share = shares + ((t * regions) << 2);
    let most = f32x4.splat(1e-30);
    for (let k = 0; k < size; k += 16) {
      let sum = f32x4.splat(0);
      for (let r = 0; r < regions; ++r) sum = madd(v128.load32_splat(share + (r << 2)), v128.load(activations + r * size + k), sum);
      v128.store(to + k, sum);
      most = f32x4.pmax(most, f32x4.abs(sum));
    }
    const largest = max(max(f32x4.extract_lane(most, 0), f32x4.extract_lane(most, 1)), max(f32x4.extract_lane(most, 2), f32x4.extract_lane(most, 3)));
    store<f32>(steps + (t << 2), largest / MOST);
    const fine = f32x4.splat(MOST / largest);
    for (let k = 0; k < size; k += 16) {
      const whole = i32x4.trunc_sat_f32x4_s(f32x4.nearest(f32x4.mul(v128.load(to + k), fine)));
      v128.store64_lane(coarse + (t * size + k >> 1), i16x8.narrow_i32x4_s(whole, whole), 0);
    }
  }
}

/** base plus its changes [n, n of activations, 4] at a Gaussian's activations. */
@inline
function changed(base: v128, changes: usize, activation: usize, used: i32): v128 {
  let sum = base;
  for (let k = 0; k < used; ++k) sum = madd(v128.load32_splat(activation + (k << 2)), v128.load(changes + (k << 4)), sum);
  return sum;
}

/** Centres in the scene. */
export function placeCentres(): void {
  let out = centres, mean = means, row = rows, change = movements;
  const along = moves << 4, end = rows + (count << 2);
  for (; row < end; row += 4, mean += 16, change += along, out += 12) {
    const t = load<i32>(row), f = frames + (t << 6), m = changed(v128.load(mean), change, table + t * (width << 2), moves);
    v128.store(out, f32x4.add(v128.load(f, 48), turned(v128.load(f), v128.load(f, 16), v128.load(f, 32), m)));
  }
}

/** Covariances in the scene. */
export function placeCovariances(): void {
  let out = covariances, shape = shapes, row = rows;
  for (const end = rows + (count << 2); row < end; row += 4, shape += 24, out += 24) {
    const f = frames + (load<i32>(row) << 6), a = v128.load(f), b = v128.load(f, 16), c = v128.load(f, 32);
    const xy = v128.load32_splat(shape, 4), xz = v128.load32_splat(shape, 8), yz = v128.load32_splat(shape, 16);
    const u = madd(c, xz, madd(b, xy, f32x4.mul(a, v128.load32_splat(shape))));
    const v = madd(c, yz, madd(b, v128.load32_splat(shape, 12), f32x4.mul(a, xy)));
    const w = madd(c, v128.load32_splat(shape, 20), madd(b, yz, f32x4.mul(a, xz)));
    const x = madd(w, v128.shuffle<f32>(c, c, 0, 0, 0, 0), madd(v, v128.shuffle<f32>(b, b, 0, 0, 0, 0), f32x4.mul(u, v128.shuffle<f32>(a, a, 0, 0, 0, 0))));
    const y = madd(w, v128.shuffle<f32>(c, c, 1, 1, 1, 1), madd(v, v128.shuffle<f32>(b, b, 1, 1, 1, 1), f32x4.mul(u, v128.shuffle<f32>(a, a, 1, 1, 1, 1))));
    const z = madd(w, v128.shuffle<f32>(c, c, 2, 2, 2, 2), madd(v, v128.shuffle<f32>(b, b, 2, 2, 2, 2), f32x4.mul(u, v128.shuffle<f32>(a, a, 2, 2, 2, 2))));
    v128.store(out, x);
    v128.store(out, v128.shuffle<f32>(y, z, 1, 2, 6, 7), 12);
  }
}

/** Rotations in the scene. */
export function placeRotations(): void {
  let out = rotations, quat = quats, row = rows;
  for (const end = rows + (count << 2); row < end; row += 4, quat += 16, out += 16) {
    const t = v128.load(turns + (load<i32>(row) << 4)), q = v128.load(quat);
    const x = v128.shuffle<f32>(q, q, 3, 2, 1, 0), y = v128.shuffle<f32>(q, q, 2, 3, 0, 1), z = v128.shuffle<f32>(q, q, 1, 0, 3, 2);
    let sum = f32x4.mul(v128.shuffle<f32>(t, t, 3, 3, 3, 3), q);
    sum = madd(f32x4.mul(v128.shuffle<f32>(t, t, 0, 0, 0, 0), x), f32x4(1, -1, 1, -1), sum);
    sum = madd(f32x4.mul(v128.shuffle<f32>(t, t, 1, 1, 1, 1), y), f32x4(1, 1, -1, -1), sum);
    v128.store(out, madd(f32x4.mul(v128.shuffle<f32>(t, t, 2, 2, 2, 2), z), f32x4(-1, 1, 1, -1), sum));
  }
}

/** Standard deviations in the scene. */
export function placeScales(): void {
  let out = scales, spread = spreads, row = rows;
  for (const end = rows + (count << 2); row < end; row += 4, spread += 16, out += 12) v128.store(out, f32x4.mul(v128.load(spread), v128.load32_splat(sizes + (load<i32>(row) << 2))));
}

/** Blends the features of a Gaussian, of triangle t. */
@inline
function blend(i: i32, t: i32, to: usize): void {
  const step = f32x4.splat(load<f32>(basisSteps + (i << 2)) * load<f32>(steps + (t << 2))), pairs = width >> 1;
  const activation = coarse + ((t * width) << 1), basis = bases + i * width * features, from = neutral + ((i * features) << 2);
  for (let k = 0; k < features; k += 16) {
    let a = i32x4.splat(0), b = a, c = a, d = a;
    for (let p = 0, at = basis + (k << 1); p < pairs; ++p, at += features << 1) {
      const s = v128.load32_splat(activation + (p << 2));
      a = i32x4.add(a, i32x4.dot_i16x8_s(v128.load8x8_s(at), s));
      b = i32x4.add(b, i32x4.dot_i16x8_s(v128.load8x8_s(at, 8), s));
      c = i32x4.add(c, i32x4.dot_i16x8_s(v128.load8x8_s(at, 16), s));
      d = i32x4.add(d, i32x4.dot_i16x8_s(v128.load8x8_s(at, 24), s));
    }
    const n = from + (k << 2), o = to + (k << 2);
    v128.store(o, madd(f32x4.convert_i32x4_s(a), step, v128.load(n)));
    v128.store(o, madd(f32x4.convert_i32x4_s(b), step, v128.load(n, 16)), 16);
    v128.store(o, madd(f32x4.convert_i32x4_s(c), step, v128.load(n, 32)), 32);
    v128.store(o, madd(f32x4.convert_i32x4_s(d), step, v128.load(n, 48)), 48);
  }
}

@inline
function leaky(x: v128): v128 {
  return f32x4.pmax(x, f32x4.mul(x, f32x4.splat(SLOPE)));
}

/** Four products of an output's weights and 16 hidden units, to be summed. */
@inline
function products(weights: usize, a: v128, b: v128, c: v128, d: v128): v128 {
  return madd(v128.load(weights), a, madd(v128.load(weights, 16), b, madd(v128.load(weights, 32), c, f32x4.mul(v128.load(weights, 48), d))));
}

/** The four outputs of 16 hidden units. */
@inline
function outputs(weights: usize, a: v128, b: v128, c: v128, d: v128): v128 {
  a = leaky(a);
  b = leaky(b);
  c = leaky(c);
  d = leaky(d);
  const p = products(weights, a, b, c, d), q = products(weights + 64, a, b, c, d), r = products(weights + 128, a, b, c, d), s = products(weights + 192, a, b, c, d);
  const left = f32x4.add(v128.shuffle<f32>(p, q, 0, 4, 1, 5), v128.shuffle<f32>(p, q, 2, 6, 3, 7));
  const right = f32x4.add(v128.shuffle<f32>(r, s, 0, 4, 1, 5), v128.shuffle<f32>(r, s, 2, 6, 3, 7));
  return f32x4.add(v128.shuffle<f32>(left, right, 0, 1, 4, 5), v128.shuffle<f32>(left, right, 2, 3, 6, 7));
}

/** exp(x), to 3e-7 of it. */
@inline
function exp(x: v128): v128 {
  const y = f32x4.mul(f32x4.pmin(f32x4.pmax(x, f32x4.splat(-87)), f32x4.splat(87)), f32x4.splat(1.4426950408889634)), n = f32x4.nearest(y);
  const f = f32x4.mul(f32x4.sub(y, n), f32x4.splat(0.6931471805599453));
  let sum = madd(f, f32x4.splat(1.0 / 720.0), f32x4.splat(1.0 / 120.0));
  sum = madd(f, sum, f32x4.splat(1.0 / 24.0));
  sum = madd(f, sum, f32x4.splat(1.0 / 6.0));
  sum = madd(f, sum, f32x4.splat(0.5));
  sum = madd(f, sum, f32x4.splat(1));
  sum = madd(f, sum, f32x4.splat(1));
  return f32x4.mul(sum, i32x4.shl(i32x4.add(i32x4.trunc_sat_f32x4_s(n), i32x4.splat(127)), 23));
}

/** Colours as a screen shows them, and the opacity, of first coefficients and the raw opacity. */
function showColors(): void {
  const floor = f32x4.splat(least), factor = f32x4.splat(SH_C0), half = f32x4.splat(0.5), one = f32x4.splat(1);
  for (let at = colors, end = colors + (count << 4); at < end; at += 64) {
    const a = v128.load(at), b = v128.load(at, 16), c = v128.load(at, 32), d = v128.load(at, 48);
    const raw = v128.shuffle<f32>(v128.shuffle<f32>(a, b, 3, 7, 3, 7), v128.shuffle<f32>(c, d, 3, 7, 3, 7), 0, 1, 4, 5);
    const opacity = f32x4.div(one, f32x4.add(one, exp(f32x4.neg(raw))));
    v128.store(at, v128.shuffle<f32>(f32x4.pmax(madd(a, factor, half), floor), opacity, 0, 1, 2, 4));
    v128.store(at, v128.shuffle<f32>(f32x4.pmax(madd(b, factor, half), floor), opacity, 0, 1, 2, 5), 16);
    v128.store(at, v128.shuffle<f32>(f32x4.pmax(madd(c, factor, half), floor), opacity, 0, 1, 2, 6), 32);
    v128.store(at, v128.shuffle<f32>(f32x4.pmax(madd(d, factor, half), floor), opacity, 0, 1, 2, 7), 48);
  }
}

/** Colours and opacities of the activations. */
export function color(): void {
  const output = v128.load(bias), along = paints << 4, hiddenBias = bias + 16;
  for (let i = 0, out = colors; i < count; i += 2, out += 32) {
    const s = load<i32>(rows + (i << 2)), t = load<i32>(rows + (i << 2), 4), from = paint + (i << 4), change = paintings + i * along;
    let left = changed(v128.load(from), change, table + s * (width << 2), paints), right = changed(v128.load(from, 16), change + along, table + t * (width << 2), paints);
    if (features) {
      const y = blended + (features << 2);
      blend(i, s, blended);
      blend(i + 1, t, y);
      left = f32x4.add(left, output);
      right = f32x4.add(right, output);
      for (let h = 0, w = first, z = second; h < hidden; h += 16, z += 256) {
        const o = own ? own + ((i * hidden + h) << 2) : hiddenBias + (h << 2), p = own ? o + (hidden << 2) : o;
        let a = v128.load(o), b = v128.load(o, 16), c = v128.load(o, 32), d = v128.load(o, 48);
        let e = v128.load(p), f = v128.load(p, 16), g = v128.load(p, 32), k = v128.load(p, 48);
        for (let x = blended; x < y; x += 4, w += 64) {
          const l = v128.load32_splat(x), r = v128.load32_splat(x + (features << 2));
          const m = v128.load(w), n = v128.load(w, 16), q = v128.load(w, 32), v = v128.load(w, 48);
          a = madd(m, l, a);
          b = madd(n, l, b);
          c = madd(q, l, c);
          d = madd(v, l, d);
          e = madd(m, r, e);
          f = madd(n, r, f);
          g = madd(q, r, g);
          k = madd(v, r, k);
        }
        left = f32x4.add(left, outputs(z, a, b, c, d));
        right = f32x4.add(right, outputs(z, e, f, g, k));
      }
    }
    v128.store(out, left);
    v128.store(out, right, 16);
  }
  showColors();
}
