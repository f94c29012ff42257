// The compute passes and the pictures of WebGPU. The kernel and its constants are those of shaders.ts.

import { SLOPE } from "./features";

/** Threads of a workgroup, and Gaussians that a workgroup sorts. */
export const THREADS = 256;
export const TILE = 1024;

/** Most activations of an avatar. */
export const MOST_RANK = 256;

/** What the passes know of a face: activations [g, a] of the regions. */
const POSE = `
struct Pose {
  count: u32, triangles: u32, columns: u32,
  bias: vec4f,  // of the network's outputs
  activations: array<vec4f, ${MOST_RANK / 4}>,
}
@group(0) @binding(0) var<uniform> pose: Pose;`;

/** The activations of Gaussians in a triangle, which `regions` share, each with `width` of them. `binding` has the shares. */
const activation = (regions: number, width: number, binding: number): string => `
@group(0) @binding(${binding}) var<storage, read> shares: array<f32>;
fn activation(triangle: u32, k: u32) -> f32 {
  var sum = 0.;
  for (var g = 0u; g < ${regions}; g++) {
    let at = g * ${width} + k;
    sum += shares[triangle * ${regions} + g] * pose.activations[at >> 2][at & 3];
  }
  return sum;
}`;

/** Frames of triangles: `triangleFrames` of rig.ts. */
export const FRAMES = `${POSE}
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> faces: array<u32>;
@group(0) @binding(3) var<storage, read_write> frames: array<vec4f>;
const DEGENERATE_LENGTH = 1e-7;
fn at(i: u32) -> vec3f { return vec3f(points[3 * i], points[3 * i + 1], points[3 * i + 2]); }

@compute @workgroup_size(${THREADS})
fn main(@builtin(global_invocation_id) id: vec3u) {
  let f = id.x;
  if (f >= pose.triangles) { return; }
  let a = at(faces[3 * f]); let b = at(faces[3 * f + 1]); let c = at(faces[3 * f + 2]);
  var first = b - a;
  var side = c - a;
  var edge = length(first);
  if (edge < DEGENERATE_LENGTH || length(cross(first, side)) < DEGENERATE_LENGTH * edge) {
    first = vec3f(DEGENERATE_LENGTH, 0, 0);
    side = vec3f(0, DEGENERATE_LENGTH, 0);
    edge = DEGENERATE_LENGTH;
  }
  first /= edge;
  var normal = cross(first, side);
  let height = length(normal); let k = (edge + height) / 2;
  normal /= height;
  let last = cross(first, normal); let middle = (a + b + c) / 3;
  for (var row = 0u; row < 3; row++) { frames[3 * f + row] = vec4f(k * first[row], k * normal[row], k * last[row], middle[row]); }
}`;

/** Centres, first colours and raw opacities at the activations. A basis has centres and opacity, then colours. */
export const change = (regions: number, width: number): string => `${POSE}${activation(regions, width, 6)}
@group(0) @binding(1) var<storage, read> restMeans: array<vec4f>;
@group(0) @binding(2) var<storage, read> restColors: array<vec4f>;
@group(0) @binding(3) var<storage, read> basis: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> means: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> colors: array<vec4f>;

@compute @workgroup_size(${THREADS})
fn main(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= pose.count) { return; }
  var mean = restMeans[i];
  var color = restColors[i];
  for (var k = 0u; k < pose.columns; k++) {
    let a = activation(u32(mean.w), k); let first = basis[2 * (i * pose.columns + k)];
    mean += a * vec4f(first.xyz, 0);
    color += a * vec4f(basis[2 * (i * pose.columns + k) + 1].xyz, first.w);
  }
  means[i] = mean;
  colors[i] = color;
}`;

/** Adds the network of features.ts: with `texels` of features, `rank` activations of each of `regions`, `hidden` units. */
export function featureNetwork(texels: number, rank: number, hidden: number, regions: number): string {
  return `${POSE}${activation(regions, rank, 6)}
@group(0) @binding(1) var<storage, read> neutral: array<vec2u>;
@group(0) @binding(2) var<storage, read> basis: array<vec2u>;
@group(0) @binding(3) var<storage, read> own: array<vec2u>;
@group(0) @binding(4) var<storage, read> weights: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(7) var<storage, read> means: array<vec4f>;  // and the triangle
fn four(halves: vec2u) -> vec4f { return vec4f(unpack2x16float(halves.x), unpack2x16float(halves.y)); }

@compute @workgroup_size(${THREADS})
fn main(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= pose.count) { return; }
  let triangle = u32(means[i].w);
  var f: array<vec4f, ${texels}>;
  for (var t = 0u; t < ${texels}; t++) { f[t] = four(neutral[i * ${texels} + t]); }
  for (var k = 0u; k < ${rank}; k++) {
    let a = activation(triangle, k);
    if (a != 0) {
      for (var t = 0u; t < ${texels}; t++) { f[t] += a * four(basis[(i * ${rank} + k) * ${texels} + t]); }
    }
  }
  var sum = pose.bias;
  for (var h = 0u; h < ${hidden}; h++) {
    let w = h * ${texels + 1};
    var x = four(own[i * ${hidden / 4} + (h >> 2)])[h & 3];
    for (var t = 0u; t < ${texels}; t++) { x += dot(weights[w + t], f[t]); }
    sum += weights[w + ${texels}] * select(x, ${SLOPE} * x, x < 0);
  }
  colors[i] += sum;
}`;
}

/** What all passes know of a picture: 144 bytes. */
const VIEW = `
struct View {
  head: array<vec4f, 3>,        // rows of head to camera
  directions: array<vec4f, 3>,  // rows of head to the frame of the view directions
  focal: vec2f, centre: vec2f, size: vec2f,
  count: u32, shRest: u32,
  background: vec4f,            // premultiplied
}`;

/** A Gaussian as it is drawn. */
const SPLAT = `
struct Splat {
  place: vec4f,   // centre, slope, log2 of the opacity
  shape: vec4f,   // roots of sharpness and falloff; half axes of the parallelogram per unit of reach
  color: vec4f,  // and the reach
}`;

/** Depths of the visible Gaussians as the bits of positive floats; then the arguments of an indirect draw. */
const STATE_FIELDS = "near: NUMBER, far: NUMBER, vertices: u32, visible: NUMBER, firstVertex: u32, firstInstance: u32";

/** Projects Gaussians, and writes the bits of their depths: the largest number for those that cannot be seen. */
export const PROJECT = `${VIEW}${SPLAT}
struct State { ${STATE_FIELDS.replace(/NUMBER/g, "atomic<u32>")} }
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> frames: array<vec4f>;  // three for each triangle
@group(0) @binding(2) var<storage, read> means: array<vec4f>;   // and the triangle
@group(0) @binding(3) var<storage, read> shapes: array<vec4f>;  // rotation and scales
@group(0) @binding(4) var<storage, read> colors: array<vec4f>; // and the raw opacity
@group(0) @binding(5) var<storage, read> sh: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> state: State;
var<workgroup> near: atomic<u32>;
var<workgroup> far: atomic<u32>;
var<workgroup> visible: atomic<u32>;
const NEAR = 0.01;
const DILATION = 0.3;
const FOV_MARGIN = 0.3;
const LOG2_ALPHA_MIN = -7.994353437;
const HALF_LOG2E = 0.72134752044;
const UNSEEN = 0xffffffffu;

fn turn(quaternion: vec4f) -> mat3x3f {
  let q = normalize(quaternion);
  let w = q.x; let x = q.y; let y = q.z; let z = q.w;
  return mat3x3f(1. - 2. * (y * y + z * z), 2. * (x * y + w * z), 2. * (x * z - w * y),
    2. * (x * y - w * z), 1. - 2. * (x * x + z * z), 2. * (y * z + w * x),
    2. * (x * z + w * y), 2. * (y * z - w * x), 1. - 2. * (x * x + y * y));
}

fn shRest(i: u32, d: vec3f) -> vec3f {
  let x = d.x; let y = d.y; let z = d.z; let xx = x * x; let yy = y * y; let zz = z * z;
  let s = i * view.shRest;
  var c = -0.488602512 * y * sh[s].rgb + 0.488602512 * z * sh[s + 1].rgb - 0.488602512 * x * sh[s + 2].rgb;
  if (view.shRest > 3) {
    c += 1.09254843 * x * y * sh[s + 3].rgb - 1.09254843 * y * z * sh[s + 4].rgb
      + 0.315391565 * (2. * zz - xx - yy) * sh[s + 5].rgb - 1.09254843 * x * z * sh[s + 6].rgb
      + 0.546274215 * (xx - yy) * sh[s + 7].rgb;
  }
  if (view.shRest > 8) {
    c += -0.590043589 * y * (3. * xx - yy) * sh[s + 8].rgb + 2.89061144 * x * y * z * sh[s + 9].rgb
      - 0.457045799 * y * (4. * zz - xx - yy) * sh[s + 10].rgb
      + 0.373176333 * z * (2. * zz - 3. * xx - 3. * yy) * sh[s + 11].rgb
      - 0.457045799 * x * (4. * zz - xx - yy) * sh[s + 12].rgb
      + 1.44530572 * z * (xx - yy) * sh[s + 13].rgb - 0.590043589 * x * (xx - 3. * yy) * sh[s + 14].rgb;
  }
  return c;
}

// Writes the splat of a Gaussian, and returns its key.
fn project(i: u32) -> u32 {
  let color = colors[i];
  let mean = means[i];
  let f = 3 * u32(mean.w);
  let a = frames[f]; let b = frames[f + 1]; let c = frames[f + 2];
  let local = vec4f(mean.xyz, 1);
  let head = vec4f(dot(a, local), dot(b, local), dot(c, local), 1);
  let v = view.head;
  let p = vec3f(dot(v[0], head), dot(v[1], head), dot(v[2], head));
  let log2Opacity = -log2(1. + exp(min(-color.a, 80.)));
  if (p.z <= NEAR || log2Opacity < LOG2_ALPHA_MIN) { return UNSEEN; }
  let tangent = p.xy / p.z;
  let margin = FOV_MARGIN * .5 * view.size / view.focal;
  let centre = view.focal * tangent + view.centre;
  let clamped = clamp(tangent, -view.centre / view.focal - margin, (view.size - view.centre) / view.focal + margin);
  let j = view.focal / p.z;
  let n0 = j.x * (v[0].xyz - clamped.x * v[2].xyz);
  let n1 = j.y * (v[1].xyz - clamped.y * v[2].xyz);
  let frame = transpose(mat3x3f(a.xyz, b.xyz, c.xyz)) * turn(shapes[2 * i]);
  let scale = shapes[2 * i + 1].xyz;
  let u0 = (n0 * frame) * scale; let u1 = (n1 * frame) * scale; let area = cross(u0, u1);
  var xx = dot(u0, u0); var yy = dot(u1, u1); let xy = dot(u0, u1);
  let determinant = dot(area, area) + DILATION * (xx + yy) + DILATION * DILATION;
  xx += DILATION; yy += DILATION;
  if (!(xx < 1e30 && yy < 1e30 && determinant < 1e30)) { return UNSEEN; }
  // The box around the ellipse where alpha is 1/255, a little larger for what is rounded.
  let reach = sqrt(max((log2Opacity - LOG2_ALPHA_MIN) * 1.3862943611, 0.)) + .1;
  let box = reach * sqrt(vec2f(xx, yy));
  if (any(centre + box < vec2f(0)) || any(centre - box > view.size)) { return UNSEEN; }
  var rgb = 0.5 + 0.28209479177387814 * color.rgb;
  if (view.shRest > 0) {
    let eye = -(v[0].w * v[0].xyz + v[1].w * v[1].xyz + v[2].w * v[2].xyz);
    let d = normalize(head.xyz - eye); let t = view.directions;
    rgb += shRest(i, vec3f(dot(t[0].xyz, d), dot(t[1].xyz, d), dot(t[2].xyz, d)));
  }
  splats[i] = Splat(vec4f(centre, xy / yy, log2Opacity),
    vec4f(sqrt(yy / determinant * HALF_LOG2E), sqrt(HALF_LOG2E / yy), sqrt(determinant / yy), sqrt(yy)), vec4f(max(rgb, vec3f(0)), reach));
  return bitcast<u32>(p.z);
}

@compute @workgroup_size(${THREADS})
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (thread == 0) { atomicStore(&near, UNSEEN); }
  workgroupBarrier();
  let i = id.x;
  if (i < view.count) {
    let key = project(i);
    keys[i] = key;
    if (key != UNSEEN) {
      atomicMin(&near, key);
      atomicMax(&far, key);
      atomicAdd(&visible, 1);
    }
  }
  workgroupBarrier();
  if (thread == 0 && atomicLoad(&visible) > 0) {
    atomicMin(&state.near, atomicLoad(&near));
    atomicMax(&state.far, atomicLoad(&far));
    atomicAdd(&state.visible, atomicLoad(&visible));
  }
}`;

/**
 * One digit of a radix sort that keeps the order of equal keys: `count` counts the digits of each tile, `scan` finds
 * where each tile's share of a digit begins, `scatter` moves. The first pass makes the keys: 1/65535 of the range of
 * depths, farthest first; those that cannot be seen come last.
 */
export const SORT = `${VIEW}
struct State { ${STATE_FIELDS.replace(/NUMBER/g, "u32")} }
override FIRST: bool;
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> keysIn: array<u32>;
@group(0) @binding(3) var<storage, read> orderIn: array<u32>;
@group(0) @binding(4) var<storage, read_write> keysOut: array<u32>;
@group(0) @binding(5) var<storage, read_write> orderOut: array<u32>;
@group(0) @binding(6) var<storage, read_write> starts: array<u32>;  // digits of each tile
var<workgroup> counts: array<atomic<u32>, 256>;
var<workgroup> sums: array<u32, 256>;
var<workgroup> masks: array<atomic<u32>, 2048>;  // for each digit, which of the threads have it

fn keyOf(i: u32) -> u32 {
  let key = keysIn[i];
  if (!FIRST) { return key; }
  if (key == 0xffffffffu) { return 65535; }
  let near = bitcast<f32>(state.near); let far = bitcast<f32>(state.far);
  return min(u32((far - bitcast<f32>(key)) * (65535 / max(far - near, 1e-20))), 65534);
}

fn digitOf(key: u32) -> u32 { return select(key >> 8, key & 255, FIRST); }

@compute @workgroup_size(${THREADS})
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  for (var round = 0u; round < ${TILE / THREADS}; round++) {
    let i = group.x * ${TILE} + round * ${THREADS} + thread;
    if (i < view.count) { atomicAdd(&counts[digitOf(keyOf(i))], 1); }
  }
  workgroupBarrier();
  starts[group.x * 256 + thread] = atomicLoad(&counts[thread]);
}

// A single workgroup. A thread has a digit.
@compute @workgroup_size(${THREADS})
fn scan(@builtin(local_invocation_index) thread: u32) {
  let end = (view.count + ${TILE - 1}) / ${TILE} * 256;
  var sum = 0u;
  for (var k = thread; k < end; k += 256) { sum += starts[k]; }
  sums[thread] = sum;
  workgroupBarrier();
  var before = 0u;
  for (var digit = 0u; digit < thread; digit++) { before += sums[digit]; }
  for (var k = thread; k < end; k += 256) {
    let here = starts[k];
    starts[k] = before;
    before += here;
  }
}

@compute @workgroup_size(${THREADS})
fn scatter(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  let word = thread >> 5; let bit = 1u << (thread & 31);
  sums[thread] = starts[group.x * 256 + thread];
  for (var round = 0u; round < ${TILE / THREADS}; round++) {
    for (var k = thread * 8; k < thread * 8 + 8; k++) { atomicStore(&masks[k], 0); }
    workgroupBarrier();
    let i = group.x * ${TILE} + round * ${THREADS} + thread; let valid = i < view.count;
    var key = 0u; var digit = 0u;
    if (valid) {
      key = keyOf(i);
      digit = digitOf(key);
      atomicOr(&masks[digit * 8 + word], bit);
    }
    workgroupBarrier();
    if (valid) {
      var to = sums[digit] + countOneBits(atomicLoad(&masks[digit * 8 + word]) & (bit - 1));
      for (var k = digit * 8; k < digit * 8 + word; k++) { to += countOneBits(atomicLoad(&masks[k])); }
      if (FIRST) {
        keysOut[to] = key;
        orderOut[to] = i;
      } else { orderOut[to] = orderIn[i]; }
    }
    workgroupBarrier();
    for (var k = thread * 8; k < thread * 8 + 8; k++) { sums[thread] += countOneBits(atomicLoad(&masks[k])); }
  }
}`;

/** A quad for each visible Gaussian, from far to near. */
export const DRAW = `${VIEW}${SPLAT}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
struct Corner {
  @builtin(position) position: vec4f,
  @location(0) @interpolate(flat) place: vec4f,
  @location(1) @interpolate(flat) roots: vec2f,
  @location(2) @interpolate(flat) color: vec3f,
}

@vertex fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
  let s = splats[order[instance]];
  let at = s.color.a * (vec2f(f32(vertex & 1), f32(vertex >> 1)) * 2. - 1.) * s.shape.zw;
  let pixel = s.place.xy + vec2f(s.place.z * at.y + at.x, at.y);
  return Corner(vec4f(2. * pixel.x / view.size.x - 1., 1. - 2. * pixel.y / view.size.y, 0, 1), s.place, s.shape.xy, s.color.rgb);
}

@fragment fn blend(c: Corner) -> @location(0) vec4f {
  let d = c.position.xy - c.place.xy;
  let r = c.roots * vec2f(d.x - c.place.z * d.y, d.y);
  let power = c.place.w - dot(r, r);
  if (power < -7.994353437) { discard; }
  let alpha = min(exp2(power), 0.999);
  return vec4f(c.color * alpha, alpha);
}`;

/** The picture over its background. */
export const SCREEN = `${VIEW}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var picture: texture_2d<f32>;

@vertex fn corner(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(vec2f(f32(vertex & 1), f32(vertex >> 1)) * 4. - 1., 0, 1);
}

@fragment fn show(@builtin(position) at: vec4f) -> @location(0) vec4f {
  var c = textureLoad(picture, vec2i(at.xy), 0);
  c += (1. - c.a) * view.background;
  return vec4f(clamp(c.rgb, vec3f(0), vec3f(c.a)), c.a);
}`;
