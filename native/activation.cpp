#include "activation.h"

#include <algorithm>

#include "activation_kernels.h"
#include "isa.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(ActivationKernels, activation_kernels)

void sigmoid(const float* values, int64_t count, float* out) {
  constexpr int64_t kGrain = 16384;  // worth a piece of the pool's work; a whole number of vectors
  const ActivationKernels& kernels = activation_kernels();
  parallel_for((count + kGrain - 1) / kGrain, [&](int64_t piece) {
    const int64_t begin = piece * kGrain;
    kernels.sigmoid(values + begin, std::min(kGrain, count - begin), out + begin);
  });
}

}  // namespace mien
