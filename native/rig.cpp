#include "rig.h"

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "isa.h"
#include "pool.h"
#include "rig_kernels.h"

namespace mien {

MIEN_CHOOSE_KERNELS(RigKernels, rig_kernels)

namespace {

constexpr int64_t kGrain = 2048;  // triangles or Gaussians in one piece of the pool's work

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

// The gradients of a triangle's three corners.
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

// Where the entries of each of `groups` groups begin in `members`, which lists them in ascending order.
void list_members(const int64_t* group_of, int64_t count, int64_t groups, std::vector<int32_t>& begins,
                  std::vector<int32_t>& members) {
  begins.assign(groups + 1, 0);
  for (int64_t i = 0; i < count; ++i) ++begins[group_of[i] + 1];
  for (int64_t group = 0; group < groups; ++group) begins[group + 1] += begins[group];
  std::vector<int32_t> next(begins.begin(), begins.end() - 1);
  members.resize(count);
  for (int64_t i = 0; i < count; ++i) members[next[group_of[i]]++] = static_cast<int32_t>(i);
}

void check_range(const std::vector<int64_t>& indices, int64_t count, const char* message) {
  for (const int64_t index : indices) {
    if (index < 0 || index >= count) throw std::out_of_range(message);
  }
}

}  // namespace

RigTopology::RigTopology(int64_t vertices, const int64_t* corner_vertices, int64_t face_count, const int64_t* face_of,
                         int64_t count)
    : vertex_count(vertices),
      faces(corner_vertices, corner_vertices + 3 * face_count),
      face_index(face_of, face_of + count) {
  check_range(faces, vertices, "a face names a vertex that does not exist");
  check_range(face_index, face_count, "a Gaussian names a face that does not exist");
  list_members(face_index.data(), count, face_count, rider_begins, riders);
  list_members(faces.data(), 3 * face_count, vertices, corner_begins, corners);
}

RigArrays rig_arrays(const RigTopology& topology, const float* vertices, const float* local_means,
                     const float* local_quats, const float* log_scales) {
  return {vertices,
          topology.vertex_count,
          topology.faces.data(),
          static_cast<int64_t>(topology.faces.size() / 3),
          topology.face_index.data(),
          static_cast<int64_t>(topology.face_index.size()),
          local_means,
          local_quats,
          log_scales};
}

void rig_forward(const RigArrays& rig, TriangleFrame* frames, const RigWorld& world) {
  const RigKernels& kernel = rig_kernels();
  in_pieces(rig.face_count, [&](int64_t first, int64_t last) { kernel.frames(rig, first, last, frames); });
  in_pieces(rig.count, [&](int64_t first, int64_t last) { kernel.to_world(rig, first, last, frames, world); });
}

void rig_backward(const RigTopology& topology, const RigArrays& rig, const TriangleFrame* frames, const float* scales,
                  const RigGradients& gradients) {
  // Kept between calls: fresh pages cost as much as the work.
  thread_local std::vector<FrameGradient> per_gaussian;
  thread_local std::vector<CornerGradients> per_corner;
  per_gaussian.resize(rig.count);
  FrameGradient* const shares = per_gaussian.data();
  const RigKernels& kernel = rig_kernels();
  in_pieces(rig.count,
            [&](int64_t first, int64_t last) { kernel.to_local(rig, first, last, frames, scales, gradients, shares); });
  if (!gradients.vertices) return;
  // In the order of Gaussians, then of triangles: the same sums for any number of threads.
  per_corner.resize(rig.face_count);
  CornerGradients* const corners = per_corner.data();
  in_pieces(rig.face_count, [&](int64_t first, int64_t last) {
    for (int64_t face = first; face < last; ++face) {
      FrameGradient sum{};
      for (int32_t at = topology.rider_begins[face]; at < topology.rider_begins[face + 1]; ++at) {
        const FrameGradient& share = shares[topology.riders[at]];
        for (int j = 0; j < FrameGradient::kFloats; ++j) sum.floats[j] += share.floats[j];
      }
      corners[face] = frame_to_corners(frames[face], sum);
    }
  });
  in_pieces(rig.vertex_count, [&](int64_t first, int64_t last) {
    for (int64_t vertex = first; vertex < last; ++vertex) {
      Vec sum{};
      for (int32_t at = topology.corner_begins[vertex]; at < topology.corner_begins[vertex + 1]; ++at) {
        const int32_t corner = topology.corners[at];
        sum = sum + corners[corner / 3].corners[corner % 3];
      }
      gradients.vertices[3 * vertex] = sum.x, gradients.vertices[3 * vertex + 1] = sum.y;
      gradients.vertices[3 * vertex + 2] = sum.z;
    }
  });
}

}  // namespace mien
