// Gaussians bound to triangles, from their triangle's frame to world space (GaussianAvatars, CVPR 2024), and back.
#pragma once

#include <cstdint>
#include <vector>

namespace mien {

constexpr int kMostRigVertices = 1 << 24;
constexpr int kMostRigFaces = 1 << 29;  // their corners are counted in 32 bits

// The Gaussians bound to each triangle, and the corners of triangles that meet at each vertex, both in ascending order.
// Sums over them can run in parallel and still add up in one order. Throws std::out_of_range if an index does not
// exist.
struct RigTopology {
  RigTopology(int64_t vertex_count, const int64_t* faces, int64_t face_count, const int64_t* face_index, int64_t count);

  int64_t vertex_count;
  std::vector<int64_t> faces;          // [f,3]
  std::vector<int64_t> face_index;     // [n]
  std::vector<int32_t> rider_begins;   // [f + 1] into riders
  std::vector<int32_t> riders;         // [n]
  std::vector<int32_t> corner_begins;  // [v + 1] into corners
  std::vector<int32_t> corners;        // [3 f], 3 * face + corner
};

struct RigArrays {
  const float* vertices;  // [v,3], metres
  int64_t vertex_count;
  const int64_t* faces;  // [f,3], each in 0..v-1 (the caller checks)
  int64_t face_count;
  const int64_t* face_index;  // [n], each in 0..f-1 (the caller checks)
  int64_t count;              // n
  const float* local_means;   // [n,3], in units of k
  const float* local_quats;   // [n,4], wxyz, of any length
  const float* log_scales;    // [n,3], in units of k
};

// One timestep's arrays of a rig.
RigArrays rig_arrays(const RigTopology& topology, const float* vertices, const float* local_means,
                     const float* local_quats, const float* log_scales);

// world = k R local + T. R's columns: a0 along the first edge, a1 the normal, a2 = a0 x a1.
struct TriangleFrame {
  float R[9];  // row-major
  float T[3];
  float k;     // (edge_length + height) / 2
  float q[4];  // R as a unit quaternion
  float edge_length;
  float height;
  float along;  // a0 . (v2 - v0)
  // A degenerate triangle, whose first edge or height is below 1e-7 m, has a fixed R, k = 1e-7 and all three 0.
};
constexpr int kTriangleFrameFloats = sizeof(TriangleFrame) / sizeof(float);

struct RigWorld {
  float* means;   // [n,3]
  float* quats;   // [n,4], unit
  float* scales;  // [n,3]
};

struct RigGradients {
  const float* means;  // d loss / d RigWorld
  const float* quats;
  const float* scales;
  bool add;  // to what the next three hold, instead of overwriting it
  float* local_means;
  float* local_quats;
  float* log_scales;
  float* vertices;  // or null; written
};

// Fills frames [f] and the Gaussians in world space. Runs on the pool.
void rig_forward(const RigArrays& rig, TriangleFrame* frames, const RigWorld& world);

// From the frames and scales of the forward pass. The result does not depend on the number of threads.
void rig_backward(const RigTopology& topology, const RigArrays& rig, const TriangleFrame* frames, const float* scales,
                  const RigGradients& gradients);

}  // namespace mien
