#include "rig.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "isa.h"
#include "pool.h"
#include "rig_kernels.h"

namespace mien {

MIEN_CHOOSE_KERNELS(RigKernels, rig_kernels)

namespace {

constexpr int64_t kGrain = 2048;  // triangles or Gaussians that are worth a piece of the pool's work

template <typename Body>
void in_pieces(int64_t count, Body&& body) {
  parallel_for((count + kGrain - 1) / kGrain,
               [&](int64_t piece) { body(piece * kGrain, std::min((piece + 1) * kGrain, count)); });
}

struct Vec {
  float x, y, z;
};
Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
void add(float* to, Vec a) { to[0] += a.x, to[1] += a.y, to[2] += a.z; }

// What a triangle passes to its three corners.
struct CornerGradients {
  Vec corners[3];
};

// With e1 = v1 - v0 = L a0 and e2 = v2 - v0 = p a0 - h a2, a motion of the edges turns the frame by omega, where
// omega . a0 = (a1 . de2 - p / L a1 . de1) / h,  omega . a1 = -(a2 . de1) / L,  omega . a2 = (a1 . de1) / L,
// and changes the lengths by dL = a0 . de1, dh = p / L a2 . de1 - a2 . de2.
CornerGradients frame_to_corners(const TriangleFrame& frame, const FrameGradient& gradient) {
  const float *T = gradient.floats, *about = gradient.floats + 3;
  const Vec third = (1.0f / 3) * Vec{T[0], T[1], T[2]};
  Vec by_edge1{}, by_edge2{};
  if (frame.edge_length > 0) {
    const float* R = frame.R;
    const Vec a0{R[0], R[3], R[6]}, a1{R[1], R[4], R[7]}, a2{R[2], R[5], R[8]};
    const auto torque = [&](const Vec& axis) { return about[0] * axis.x + about[1] * axis.y + about[2] * axis.z; };
    const float slant = frame.along / frame.edge_length, half = 0.5f * gradient.floats[6];
    const float about_edge = torque(a0) / frame.height;
    by_edge1 = (torque(a2) / frame.edge_length - about_edge * slant) * a1 + half * a0 +
               (half * slant - torque(a1) / frame.edge_length) * a2;
    by_edge2 = about_edge * a1 + -half * a2;
  }
  return {{third + -1.0f * (by_edge1 + by_edge2), third + by_edge1, third + by_edge2}};
}

void clear_gaussians(const RigGradients& gradients, int64_t first, int64_t last) {
  const size_t bytes = sizeof(float) * static_cast<size_t>(last - first);
  std::memset(gradients.local_means + 3 * first, 0, 3 * bytes);
  std::memset(gradients.local_quats + 4 * first, 0, 4 * bytes);
  std::memset(gradients.log_scales + 3 * first, 0, 3 * bytes);
}

}  // namespace

void rig_forward(const RigArrays& rig, TriangleFrame* frames, const RigWorld& world) {
  const RigKernels& kernel = rig_kernels();
  in_pieces(rig.face_count, [&](int64_t first, int64_t last) { kernel.frames(rig, first, last, frames); });
  in_pieces(rig.count, [&](int64_t first, int64_t last) { kernel.to_world(rig, first, last, frames, world); });
}

void rig_backward(const RigArrays& rig, const TriangleFrame* frames, const float* scales,
                  const RigGradients& gradients) {
  // Kept between calls: fresh pages cost as much as the work.
  thread_local std::vector<FrameGradient> per_gaussian, per_face;
  thread_local std::vector<CornerGradients> per_corner;
  per_gaussian.resize(rig.count);
  FrameGradient* const shares = per_gaussian.data();
  const RigKernels& kernel = rig_kernels();
  in_pieces(rig.count, [&](int64_t first, int64_t last) {
    if (!gradients.add) clear_gaussians(gradients, first, last);
    kernel.to_local(rig, first, last, frames, scales, gradients, shares);
  });
  if (!gradients.vertices) return;
  // In the order of Gaussians, then of triangles: the same sums for any number of threads.
  per_face.assign(rig.face_count, FrameGradient{});
  for (int64_t i = 0; i < rig.count; ++i) {
    FrameGradient& sum = per_face[rig.face_index[i]];
    for (int j = 0; j < FrameGradient::kFloats; ++j) sum.floats[j] += shares[i].floats[j];
  }
  per_corner.resize(rig.face_count);
  CornerGradients* const corners = per_corner.data();
  const FrameGradient* const sums = per_face.data();
  in_pieces(rig.face_count, [&](int64_t first, int64_t last) {
    for (int64_t face = first; face < last; ++face) corners[face] = frame_to_corners(frames[face], sums[face]);
  });
  std::memset(gradients.vertices, 0, sizeof(float) * 3 * static_cast<size_t>(rig.vertex_count));
  for (int64_t face = 0; face < rig.face_count; ++face) {
    for (int corner = 0; corner < 3; ++corner) {
      add(gradients.vertices + 3 * rig.faces[3 * face + corner], corners[face].corners[corner]);
    }
  }
}

}  // namespace mien
