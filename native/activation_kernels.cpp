// Compiled once per instruction set.
#include "activation_kernels.h"

#include "simd.h"

namespace mien::MIEN_ISA {
namespace {

void sigmoid(const float* values, int64_t count, float* out) {
  for (int64_t i = 0; i < count; i += W) {
    const int64_t valid = count - i < W ? count - i : W;
    F value{};
    memcpy(&value, values + i, sizeof(float) * valid);
    const F faded = exp2_fast(clamp(value * -1.44269504f, set1(-99.0f), set1(99.0f)));
    // Clamping turned NaN into a number; this restores it.
    const F result = select(less_equal(value, value), 1.0f / (1.0f + faded), value);
    memcpy(out + i, &result, sizeof(float) * valid);
  }
}

}  // namespace

extern const ActivationKernels activation_kernels;
const ActivationKernels activation_kernels = {sigmoid};

}  // namespace mien::MIEN_ISA
