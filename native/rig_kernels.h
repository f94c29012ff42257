// What rig.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include "rig.h"

namespace mien {

// What a Gaussian passes to its triangle: d loss / d T [3], the torque d loss / d (small world rotation of R) [3],
// d loss / d k, and a zero. In one array, because they are added up together.
struct FrameGradient {
  static constexpr int kFloats = 8;
  float floats[kFloats];
};

struct RigKernels {
  // Triangles, then Gaussians, first .. last - 1.
  void (*frames)(const RigArrays&, int64_t first, int64_t last, TriangleFrame*);
  void (*to_world)(const RigArrays&, int64_t first, int64_t last, const TriangleFrame*, const RigWorld&);
  // Writes or adds to (RigGradients::add) the gradients of the Gaussians' own parameters; writes one FrameGradient a
  // Gaussian.
  void (*to_local)(const RigArrays&, int64_t first, int64_t last, const TriangleFrame*, const float* scales,
                   const RigGradients&, FrameGradient*);
};

}  // namespace mien
