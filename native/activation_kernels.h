// What activation.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include <cstdint>

namespace mien {

struct ActivationKernels {
  void (*sigmoid)(const float* values, int64_t count, float* out);
};

}  // namespace mien
