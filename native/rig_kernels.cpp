// Compiled once per instruction set; one Gaussian at a time, since its triangle's frame is gathered anyway.
#include "rig_kernels.h"

#include "simd.h"

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
MIEN_INLINE void add(float* to, Vec a) { to[0] += a.x, to[1] += a.y, to[2] += a.z; }

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

// exp over `count` floats, in place of a library call for each.
MIEN_INLINE void exponentials(const float* from, int count, float* to) {
  for (int x = 0; x < count; x += W) {
    F value{};
    if (x + W <= count) {
      value = load(from + x);
    } else {
      for (int lane = 0; lane < count - x; ++lane) value[lane] = from[x + lane];
    }
    store(to + x, exp2_fast(clamp(value * 1.44269504f, set1(-99.0f), set1(99.0f))));
  }
}

void to_world(const RigArrays& rig, int64_t first, int64_t last, const TriangleFrame* frames, const RigWorld& world) {
  constexpr int CHUNK = 64;
  float local_scales[3 * CHUNK + W];
  for (int64_t begin = first; begin < last; begin += CHUNK) {
    const int64_t end = begin + CHUNK < last ? begin + CHUNK : last;
    exponentials(rig.log_scales + 3 * begin, (int)(3 * (end - begin)), local_scales);
    for (int64_t i = begin; i < end; ++i) {
      const TriangleFrame& frame = frames[rig.face_index[i]];
      const float *R = frame.R, *p = frame.q, *q = rig.local_quats + 4 * i;
      const Vec m = at(rig.local_means + 3 * i);
      const Vec turned = {dot(at(R), m), dot(at(R + 3), m), dot(at(R + 6), m)};
      put(world.means + 3 * i, frame.k * turned + at(frame.T));
      put(world.scales + 3 * i, frame.k * at(local_scales + 3 * (i - begin)));
      // As torch's normalize: a zero quaternion stays zero.
      const float norm = __builtin_sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
      const float unit = 1 / (norm > 1e-12f ? norm : 1e-12f);
      const float w = q[0] * unit, x = q[1] * unit, y = q[2] * unit, z = q[3] * unit;
      float* out = world.quats + 4 * i;
      out[0] = p[0] * w - p[1] * x - p[2] * y - p[3] * z;
      out[1] = p[0] * x + p[1] * w + p[2] * z - p[3] * y;
      out[2] = p[0] * y - p[1] * z + p[2] * w + p[3] * x;
      out[3] = p[0] * z + p[1] * y - p[2] * x + p[3] * w;
    }
  }
}

// d loss / d local quaternion, added; returns the torque that the world quaternion's gradient exerts.
MIEN_INLINE Vec quaternion_to_local(const float* p, const float* local, const float* g, float* gradient) {
  const float norm =
      __builtin_sqrtf(local[0] * local[0] + local[1] * local[1] + local[2] * local[2] + local[3] * local[3]);
  const float unit = 1 / (norm > 1e-12f ? norm : 1e-12f);
  const float q[4] = {local[0] * unit, local[1] * unit, local[2] * unit, local[3] * unit};
  // Multiplication by p is orthogonal: its adjoint is multiplication by p's conjugate.
  const float h[4] = {
      p[0] * g[0] + p[1] * g[1] + p[2] * g[2] + p[3] * g[3], p[0] * g[1] - p[1] * g[0] - p[2] * g[3] + p[3] * g[2],
      p[0] * g[2] + p[1] * g[3] - p[2] * g[0] - p[3] * g[1], p[0] * g[3] - p[1] * g[2] + p[2] * g[1] - p[3] * g[0]};
  const float radial = q[0] * h[0] + q[1] * h[1] + q[2] * h[2] + q[3] * h[3];
  for (int i = 0; i < 4; ++i) gradient[i] += (h[i] - radial * q[i]) * unit;
  // A small rotation omega changes the world quaternion r = p q by (0, omega) r / 2.
  const float w = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
  const Vec v = {p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
                 p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
                 p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]};
  return 0.5f * (w * at(g + 1) - g[0] * v + cross(v, at(g + 1)));
}

void to_local(const RigArrays& rig, int64_t first, int64_t last, const TriangleFrame* frames, const float* scales,
              const RigGradients& gradients, FrameGradient* out) {
  for (int64_t i = first; i < last; ++i) {
    const TriangleFrame& frame = frames[rig.face_index[i]];
    const float* R = frame.R;
    const Vec m = at(rig.local_means + 3 * i), g = at(gradients.means + 3 * i);
    const Vec turned = {dot(at(R), m), dot(at(R + 3), m), dot(at(R + 6), m)};
    const Vec turned_back = {R[0] * g.x + R[3] * g.y + R[6] * g.z, R[1] * g.x + R[4] * g.y + R[7] * g.z,
                             R[2] * g.x + R[5] * g.y + R[8] * g.z};
    add(gradients.local_means + 3 * i, frame.k * turned_back);
    const float *scale = scales + 3 * i, *scale_gradient = gradients.scales + 3 * i;
    const Vec by_log = {scale[0] * scale_gradient[0], scale[1] * scale_gradient[1], scale[2] * scale_gradient[2]};
    add(gradients.log_scales + 3 * i, by_log);
    const Vec torque =
        quaternion_to_local(frame.q, rig.local_quats + 4 * i, gradients.quats + 4 * i, gradients.local_quats + 4 * i);
    put(out[i].T, g);
    put(out[i].torque, torque + frame.k * cross(turned, g));
    out[i].k = dot(turned, g) + (by_log.x + by_log.y + by_log.z) / frame.k;
  }
}

}  // namespace

extern const RigKernels rig_kernels;
const RigKernels rig_kernels = {frames, to_world, to_local};

}  // namespace mien::MIEN_ISA
