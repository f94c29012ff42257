// What expression_change.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include <cstdint>

namespace mien {

// Both by rank - 1.
struct ExpressionKernels {
  void (*change[8])(const float* basis, const float* activations, int64_t count, float* out);
  // Writes `sums` [rank], the gradient of the activations.
  void (*backward[8])(const float* basis, const float* activations, const float* gradient, int64_t count,
                      float* grad_basis, double* sums);
};

}  // namespace mien
