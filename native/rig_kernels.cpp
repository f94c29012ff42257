// Compiled once per instruction set: triangles one at a time, Gaussians one a lane.
#include "rig_kernels.h"

#include "simd_columns.h"

namespace mien::MIEN_ISA {
namespace {

constexpr float DEGENERATE_LENGTH = 1e-7f;

struct Vec {
  float x, y, z;
};

MIEN_INLINE Vec at(const float* from) { return {from[0], from[1], from[2]}; }
MIEN_INLINE Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
MIEN_INLINE Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
MIEN_INLINE Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
MIEN_INLINE float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
MIEN_INLINE Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
MIEN_INLINE float length(Vec a) { return __builtin_sqrtf(dot(a, a)); }
MIEN_INLINE void put(float* to, Vec a) { to[0] = a.x, to[1] = a.y, to[2] = a.z; }

// The same four formulas as mien.rotation.quaternion_from_matrix: the one with the largest divisor.
MIEN_INLINE void quaternion_from_matrix(const float* m, float* q) {
  const float divisors[4] = {1 + m[0] + m[4] + m[8], 1 + m[0] - m[4] - m[8], 1 - m[0] + m[4] - m[8],
                             1 - m[0] - m[4] + m[8]};
  int best = 0;
  for (int i = 1; i < 4; ++i)
    if (divisors[i] > divisors[best]) best = i;
  const float a = m[7] - m[5], b = m[2] - m[6], c = m[3] - m[1];
  const float d = m[1] + m[3], e = m[2] + m[6], f = m[5] + m[7];
  const float rows[4][4] = {
      {divisors[0], a, b, c}, {a, divisors[1], d, e}, {b, d, divisors[2], f}, {c, e, f, divisors[3]}};
  const float* row = rows[best];
  const float scale = 1 / __builtin_sqrtf(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3]);
  for (int i = 0; i < 4; ++i) q[i] = row[i] * scale;
}

void frames(const RigArrays& rig, int64_t first, int64_t last, TriangleFrame* out) {
  for (int64_t face = first; face < last; ++face) {
    const int64_t* index = rig.faces + 3 * face;
    const Vec v0 = at(rig.vertices + 3 * index[0]), v1 = at(rig.vertices + 3 * index[1]);
    const Vec v2 = at(rig.vertices + 3 * index[2]);
    Vec edge = v1 - v0, other = v2 - v0;
    const float edge_length = length(edge);
    const bool degenerate =
        edge_length < DEGENERATE_LENGTH || length(cross(edge, other)) < DEGENERATE_LENGTH * edge_length;
    if (degenerate) edge = {DEGENERATE_LENGTH, 0, 0}, other = {0, DEGENERATE_LENGTH, 0};
    const Vec a0 = (1 / length(edge)) * edge;
    const Vec area_normal = cross(a0, other);
    const float height = length(area_normal);
    const Vec a1 = (1 / height) * area_normal;
    const Vec a2 = cross(a0, a1);
    TriangleFrame& frame = out[face];
    const float R[9] = {a0.x, a1.x, a2.x, a0.y, a1.y, a2.y, a0.z, a1.z, a2.z};
    for (int i = 0; i < 9; ++i) frame.R[i] = R[i];
    put(frame.T, (1.0f / 3) * (v0 + v1 + v2));
    frame.k = 0.5f * (length(edge) + height);
    quaternion_from_matrix(frame.R, frame.q);
    frame.edge_length = degenerate ? 0 : edge_length;
    frame.height = degenerate ? 0 : height;
    frame.along = degenerate ? 0 : dot(a0, other);
  }
}

// Vectors of three and of four whose components are vectors of W lanes: one Gaussian a lane.
MIEN_INLINE void turn(const F* R, const F* v, F* out) {
  for (int row = 0; row < 3; ++row) out[row] = R[3 * row] * v[0] + R[3 * row + 1] * v[1] + R[3 * row + 2] * v[2];
}
MIEN_INLINE void turn_back(const F* R, const F* v, F* out) {
  for (int column = 0; column < 3; ++column)
    out[column] = R[column] * v[0] + R[3 + column] * v[1] + R[6 + column] * v[2];
}
MIEN_INLINE void cross(const F* a, const F* b, F* out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}
MIEN_INLINE void multiply_quaternions(const F* p, const F* q, F* out) {
  out[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
  out[1] = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2];
  out[2] = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1];
  out[3] = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0];
}
// Scales a quaternion to length 1 and returns by what; as torch's normalize: a zero quaternion stays zero.
MIEN_INLINE F normalize(F* q) {
  const F norm = square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const F unit = 1.0f / maximum(norm, set1(1e-12f));
  for (int i = 0; i < 4; ++i) q[i] = q[i] * unit;
  return unit;
}

// The frames of the triangles that Gaussians i .. i + valid - 1 ride on; lanes from `valid` on repeat the last one.
struct FrameColumns {
  F columns[sizeof(TriangleFrame) / sizeof(float)];
  const F *R = columns, *T = columns + 9, *k = columns + 12, *q = columns + 13;

  MIEN_INLINE FrameColumns(const RigArrays& rig, int64_t i, int valid, const TriangleFrame* frames) {
    static_assert(__builtin_offsetof(TriangleFrame, T) == 9 * sizeof(float));
    static_assert(__builtin_offsetof(TriangleFrame, q) == 13 * sizeof(float));
    const float* rows[W];
    for (int lane = 0; lane < W; ++lane) rows[lane] = frames[rig.face_index[i + (lane < valid ? lane : valid - 1)]].R;
    gather_columns<17>(rows, columns);
  }
};

void to_world(const RigArrays& rig, int64_t first, int64_t last, const TriangleFrame* frames, const RigWorld& world) {
  for (int64_t i = first; i < last; i += W) {
    const int valid = last - i < W ? (int)(last - i) : W;
    const FrameColumns frame(rig, i, valid, frames);
    F local[4], out[4];
    load_columns<3>(rig.local_means + 3 * i, 3, valid, local);
    turn(frame.R, local, out);
    for (int axis = 0; axis < 3; ++axis) out[axis] = *frame.k * out[axis] + frame.T[axis];
    store_columns<3>(world.means + 3 * i, 3, valid, out);
    load_columns<3>(rig.log_scales + 3 * i, 3, valid, local);
    for (int axis = 0; axis < 3; ++axis)
      out[axis] = *frame.k * exp2_fast(clamp(local[axis] * 1.44269504f, set1(-99.0f), set1(99.0f)));
    store_columns<3>(world.scales + 3 * i, 3, valid, out);
    load_columns<4>(rig.local_quats + 4 * i, 4, valid, local);
    normalize(local);
    multiply_quaternions(frame.q, local, out);
    store_columns<4>(world.quats + 4 * i, 4, valid, out);
  }
}

// Adds to some columns in memory.
template <int COUNT>
MIEN_INLINE void add_columns(float* rows, int valid, const F* columns) {
  F sums[COUNT];
  load_columns<COUNT>(rows, COUNT, valid, sums);
  for (int j = 0; j < COUNT; ++j) sums[j] = sums[j] + columns[j];
  store_columns<COUNT>(rows, COUNT, valid, sums);
}

// d loss / d local quaternion; and the torque that the world quaternion's gradient `g` exerts.
MIEN_INLINE void quaternion_to_local(const F* p, F* q, const F* g, F* gradient, F* torque) {
  const F unit = normalize(q);
  // Multiplication by p is orthogonal: its adjoint is multiplication by p's conjugate.
  const F conjugate[4] = {p[0], -p[1], -p[2], -p[3]};
  F h[4], world[4];
  multiply_quaternions(conjugate, g, h);
  const F radial = q[0] * h[0] + q[1] * h[1] + q[2] * h[2] + q[3] * h[3];
  for (int i = 0; i < 4; ++i) gradient[i] = (h[i] - radial * q[i]) * unit;
  // A small rotation omega changes the world quaternion by (0, omega) world / 2.
  multiply_quaternions(p, q, world);
  cross(world + 1, g + 1, torque);
  for (int axis = 0; axis < 3; ++axis)
    torque[axis] = 0.5f * (world[0] * g[1 + axis] - g[0] * world[1 + axis] + torque[axis]);
}

void to_local(const RigArrays& rig, int64_t first, int64_t last, const TriangleFrame* frames, const float* scales,
              const RigGradients& gradients, FrameGradient* out) {
  static_assert(sizeof(FrameGradient) == 8 * sizeof(float));
  for (int64_t i = first; i < last; i += W) {
    const int valid = last - i < W ? (int)(last - i) : W;
    const FrameColumns frame(rig, i, valid, frames);
    F local[4], g[4], turned[3], by_local[4], share[8], about[3];
    load_columns<3>(rig.local_means + 3 * i, 3, valid, local);
    load_columns<3>(gradients.means + 3 * i, 3, valid, g);
    turn(frame.R, local, turned);
    turn_back(frame.R, g, by_local);
    for (int axis = 0; axis < 3; ++axis) by_local[axis] = *frame.k * by_local[axis];
    add_columns<3>(gradients.local_means + 3 * i, valid, by_local);
    cross(turned, g, about);
    for (int axis = 0; axis < 3; ++axis) share[axis] = g[axis];
    F by_size = turned[0] * g[0] + turned[1] * g[1] + turned[2] * g[2];

    load_columns<3>(scales + 3 * i, 3, valid, local);
    load_columns<3>(gradients.scales + 3 * i, 3, valid, g);
    for (int axis = 0; axis < 3; ++axis) by_local[axis] = local[axis] * g[axis];
    add_columns<3>(gradients.log_scales + 3 * i, valid, by_local);
    by_size = by_size + (by_local[0] + by_local[1] + by_local[2]) / *frame.k;

    load_columns<4>(rig.local_quats + 4 * i, 4, valid, local);
    load_columns<4>(gradients.quats + 4 * i, 4, valid, g);
    quaternion_to_local(frame.q, local, g, by_local, share + 3);
    add_columns<4>(gradients.local_quats + 4 * i, valid, by_local);
    for (int axis = 0; axis < 3; ++axis) share[3 + axis] = share[3 + axis] + *frame.k * about[axis];
    share[6] = by_size;
    share[7] = F{};
    store_columns<8>(out[i].T, 8, valid, share);
  }
}

}  // namespace

extern const RigKernels rig_kernels;
const RigKernels rig_kernels = {frames, to_world, to_local};

}  // namespace mien::MIEN_ISA
