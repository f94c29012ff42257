// Points from their places in one pose of a skeleton to those in others (src/mien/avatar/ops/skin_points.py has the
// same in PyTorch): skinning undone, displacements added, skinned again.
#pragma once

#include <cstdint>

namespace mien {

struct SkinPoints {
  int64_t count, poses;
  int bones;             // at most kMostBones
  const float* points;   // [n, 3], in the first pose
  const float* moved;    // [b, n, 3], added before they are skinned again
  const float* weights;  // [n, k]
  const float* from;     // [k, 3, 4], of the first pose
  const float* to;       // [b, k, 3, 4]
};
constexpr int kMostBones = 64;

// Fills `posed` [b, n, 3]. Runs on the pool.
void skin_points(const SkinPoints& task, float* posed);

struct SkinPointsGradients {
  const float* posed;  // [b, n, 3]
  float *points, *moved, *weights, *to;
};
// The result does not depend on the number of threads. Runs on the pool.
void skin_points_backward(const SkinPoints& task, const SkinPointsGradients& gradients);

}  // namespace mien
