#include "activation.h"

#include <algorithm>

#include "activation_kernels.h"
#include "isa.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(ActivationKernels, activation_kernels)

namespace {

constexpr int64_t kGrain = 16384;  // in one piece of the pool's work; a whole number of vectors

}  // namespace

void sigmoid(const float* values, int64_t count, float* out) {
  const ActivationKernels& kernels = activation_kernels();
  parallel_for((count + kGrain - 1) / kGrain, [&](int64_t piece) {
    const int64_t begin = piece * kGrain;
    kernels.sigmoid(values + begin, std::min(kGrain, count - begin), out + begin);
  });
}

void sigmoid_backward(const float* outputs, const float* gradient, int64_t count, float* out) {
  parallel_for((count + kGrain - 1) / kGrain, [&](int64_t piece) {
    const int64_t end = std::min((piece + 1) * kGrain, count);
    for (int64_t i = piece * kGrain; i < end; ++i) out[i] = gradient[i] * outputs[i] * (1 - outputs[i]);
  });
}

}  // namespace mien
