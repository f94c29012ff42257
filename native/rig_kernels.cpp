// Compiled once per instruction set: one triangle per lane, then one Gaussian per lane.
#include "rig_kernels.h"

#include "simd_columns.h"

namespace mien::MIEN_ISA {
namespace {

constexpr float DEGENERATE_LENGTH = 1e-7f;

// Vectors of three and of four whose components are vectors of W lanes: one Gaussian per lane.
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
// Scales a quaternion to length 1 and returns the factor. As in torch's normalize, a zero quaternion stays zero.
MIEN_INLINE F normalize(F* q) {
  const F norm = square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const F unit = 1.0f / maximum(norm, set1(1e-12f));
  for (int i = 0; i < 4; ++i) q[i] = q[i] * unit;
  return unit;
}

// The corners of triangles first .. first + valid - 1, by corner and axis.
MIEN_INLINE void load_corners(const RigArrays& rig, int64_t first, int valid, F corners[3][3]) {
  alignas(64) float buffer[3][3][W];
  for (int lane = 0; lane < W; ++lane) {
    const int64_t* index = rig.faces + 3 * (first + (lane < valid ? lane : valid - 1));
    for (int corner = 0; corner < 3; ++corner)
      for (int axis = 0; axis < 3; ++axis) buffer[corner][axis][lane] = rig.vertices[3 * index[corner] + axis];
  }
  for (int corner = 0; corner < 3; ++corner)
    for (int axis = 0; axis < 3; ++axis) corners[corner][axis] = load(buffer[corner][axis]);
}

MIEN_INLINE F dot(const F* a, const F* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
MIEN_INLINE F length(const F* a) { return square_root(dot(a, a)); }
MIEN_INLINE void scale(F by, const F* v, F* out) {
  for (int axis = 0; axis < 3; ++axis) out[axis] = by * v[axis];
}

// The same four formulas as mien.rotation.quaternion_from_matrix: the one with the largest divisor.
MIEN_INLINE void quaternion_from_matrix(const F* m, F* q) {
  const F divisors[4] = {1.0f + m[0] + m[4] + m[8], 1.0f + m[0] - m[4] - m[8], 1.0f - m[0] + m[4] - m[8],
                         1.0f - m[0] - m[4] + m[8]};
  const F a = m[7] - m[5], b = m[2] - m[6], c = m[3] - m[1];
  const F d = m[1] + m[3], e = m[2] + m[6], f = m[5] + m[7];
  const F rows[4][4] = {{divisors[0], a, b, c}, {a, divisors[1], d, e}, {b, d, divisors[2], f}, {c, e, f, divisors[3]}};
  F best = divisors[0];
  for (int i = 0; i < 4; ++i) q[i] = rows[0][i];
  for (int row = 1; row < 4; ++row) {
    const M better = less(best, divisors[row]);
    best = select(better, divisors[row], best);
    for (int i = 0; i < 4; ++i) q[i] = select(better, rows[row][i], q[i]);
  }
  const F unit = 1.0f / square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int i = 0; i < 4; ++i) q[i] = q[i] * unit;
}

void frames(const RigArrays& rig, int64_t first, int64_t last, TriangleFrame* out) {
  constexpr int kFloats = sizeof(TriangleFrame) / sizeof(float);
  for (int64_t face = first; face < last; face += W) {
    const int valid = last - face < W ? (int)(last - face) : W;
    F v[3][3], edge[3], other[3], normal[3], columns[kFloats];
    load_corners(rig, face, valid, v);
    for (int axis = 0; axis < 3; ++axis) {
      edge[axis] = v[1][axis] - v[0][axis];
      other[axis] = v[2][axis] - v[0][axis];
    }
    cross(edge, other, normal);
    const F edge_length = length(edge);
    const M degenerate =
        either(less(edge_length, set1(DEGENERATE_LENGTH)), less(length(normal), DEGENERATE_LENGTH * edge_length));
    for (int axis = 0; axis < 3; ++axis) {
      edge[axis] = select(degenerate, set1(axis == 0 ? DEGENERATE_LENGTH : 0.0f), edge[axis]);
      other[axis] = select(degenerate, set1(axis == 1 ? DEGENERATE_LENGTH : 0.0f), other[axis]);
    }
    F a0[3], a1[3], a2[3];
    const F usable_length = length(edge);
    scale(1.0f / usable_length, edge, a0);
    cross(a0, other, normal);
    const F height = length(normal);
    scale(1.0f / height, normal, a1);
    cross(a0, a1, a2);
    for (int axis = 0; axis < 3; ++axis) {
      columns[3 * axis] = a0[axis];
      columns[3 * axis + 1] = a1[axis];
      columns[3 * axis + 2] = a2[axis];
      columns[9 + axis] = (1.0f / 3) * (v[0][axis] + v[1][axis] + v[2][axis]);
    }
    columns[12] = 0.5f * (usable_length + height);
    quaternion_from_matrix(columns, columns + 13);
    columns[17] = select(degenerate, F{}, edge_length);
    columns[18] = select(degenerate, F{}, height);
    columns[19] = select(degenerate, F{}, dot(a0, other));
    store_columns<kFloats>(out[face].R, kFloats, valid, columns);
  }
}

// The frames of the triangles that Gaussians i .. i + valid - 1 are bound to; lanes from `valid` on repeat the last
// one.
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

// Writes some columns to memory, or adds to those there.
template <int COUNT>
MIEN_INLINE void put_columns(float* rows, int valid, bool add, const F* columns) {
  F sums[COUNT];
  if (add) {
    load_columns<COUNT>(rows, COUNT, valid, sums);
    for (int j = 0; j < COUNT; ++j) sums[j] = sums[j] + columns[j];
    columns = sums;
  }
  store_columns<COUNT>(rows, COUNT, valid, columns);
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
    put_columns<3>(gradients.local_means + 3 * i, valid, gradients.add, by_local);
    cross(turned, g, about);
    for (int axis = 0; axis < 3; ++axis) share[axis] = g[axis];
    F by_size = turned[0] * g[0] + turned[1] * g[1] + turned[2] * g[2];

    load_columns<3>(scales + 3 * i, 3, valid, local);
    load_columns<3>(gradients.scales + 3 * i, 3, valid, g);
    for (int axis = 0; axis < 3; ++axis) by_local[axis] = local[axis] * g[axis];
    put_columns<3>(gradients.log_scales + 3 * i, valid, gradients.add, by_local);
    by_size = by_size + (by_local[0] + by_local[1] + by_local[2]) / *frame.k;

    load_columns<4>(rig.local_quats + 4 * i, 4, valid, local);
    load_columns<4>(gradients.quats + 4 * i, 4, valid, g);
    quaternion_to_local(frame.q, local, g, by_local, share + 3);
    put_columns<4>(gradients.local_quats + 4 * i, valid, gradients.add, by_local);
    for (int axis = 0; axis < 3; ++axis) share[3 + axis] = share[3 + axis] + *frame.k * about[axis];
    share[6] = by_size;
    share[7] = F{};
    store_columns<8>(out[i].floats, 8, valid, share);
  }
}

}  // namespace

extern const RigKernels rig_kernels;
const RigKernels rig_kernels = {frames, to_world, to_local};

}  // namespace mien::MIEN_ISA
