#include "expression_change.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "expression_change_kernels.h"
#include "isa.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(ExpressionKernels, expression_kernels)

namespace {

constexpr int64_t kGrain = 8192;  // values in one piece of the pool's work; a whole number of vectors
constexpr float kMargin = 0.1f;   // the same numbers as in Python
constexpr float kLeastSeen = 1e-6f;

// Fills out [rank] with (inputs - rest) directions.
void project(const ActivationArrays& arrays, float* out) {
  for (int64_t k = 0; k < arrays.rank; ++k) {
    float sum = 0;
    for (int64_t i = 0; i < arrays.inputs_count; ++i) {
      sum += (arrays.inputs[i] - arrays.rest[i]) * arrays.directions[i * arrays.rank + k];
    }
    out[k] = sum;
  }
}

float dot(const float* one, const float* other, int64_t count) {
  float sum = 0;
  for (int64_t k = 0; k < count; ++k) sum += one[k] * other[k];
  return sum;
}

// How far activations are beyond what training saw, and by what they are multiplied.
struct Beyond {
  float squares;          // of the activations' length
  float seen;             // the largest product of the activations with seen ones
  const float* furthest;  // [rank]: these seen ones; null if nothing is shortened
  float ratio;  // squares / seen: the length, in units of the furthest that training saw along the activations
  float factor;
};

Beyond beyond(const ActivationArrays& arrays, const float* values) {
  Beyond found{dot(values, values, arrays.rank), 0, nullptr, 0, 1};
  for (int64_t s = 0; s < arrays.seen_count; ++s) {
    const float* row = arrays.seen + s * arrays.rank;
    const float product = dot(values, row, arrays.rank);
    if (!found.furthest || product > found.seen) found.seen = product, found.furthest = row;
  }
  found.seen = std::max(found.seen, kLeastSeen);
  found.ratio = found.squares / found.seen;
  const float over = found.ratio - 1;
  if (!found.furthest || !(over > 0)) {
    found.furthest = nullptr;
  } else {
    found.factor = (1 + kMargin * over / (kMargin + over)) / found.ratio;
  }
  return found;
}

}  // namespace

// No operation here may round in two ways, so these two use neither `exp` nor a kernel.
void expression_activations(const ActivationArrays& arrays, float* out) {
  project(arrays, out);
  const float factor = beyond(arrays, out).factor;
  for (int64_t k = 0; k < arrays.rank; ++k) out[k] *= factor;
}

void expression_activations_backward(const ActivationArrays& arrays, const float* gradient, float* grad_inputs) {
  std::vector<float> values(arrays.rank), by_values(gradient, gradient + arrays.rank);
  project(arrays, values.data());
  const Beyond found = beyond(arrays, values.data());
  if (found.furthest) {
    const float share = kMargin / (kMargin + found.ratio - 1), slope = share * share / found.ratio;
    const float along = dot(gradient, values.data(), arrays.rank) * (slope - found.factor / found.ratio);
    const bool floored = !(dot(values.data(), found.furthest, arrays.rank) > kLeastSeen);
    const float by_seen = floored ? 0 : found.ratio / found.seen;
    for (int64_t k = 0; k < arrays.rank; ++k) {
      by_values[k] = found.factor * gradient[k] + along * (2 * values[k] / found.seen - by_seen * found.furthest[k]);
    }
  }
  for (int64_t i = 0; i < arrays.inputs_count; ++i) {
    grad_inputs[i] = dot(arrays.directions + i * arrays.rank, by_values.data(), arrays.rank);
  }
}

void expression_change(const float* basis, const float* activations, int rank, int64_t count, float* out) {
  const auto kernel = expression_kernels().change[rank - 1];
  parallel_for((count + kGrain - 1) / kGrain, [&](int64_t piece) {
    const int64_t first = piece * kGrain;
    kernel(basis + first * rank, activations, std::min(kGrain, count - first), out + first);
  });
}

void expression_change_backward(const float* basis, const float* activations, const float* gradient, int rank,
                                int64_t count, float* grad_basis, float* grad_activations) {
  using Sums = std::array<double, kMostExpressionRank>;
  const auto kernel = expression_kernels().backward[rank - 1];
  const int64_t pieces = (count + kGrain - 1) / kGrain;
  thread_local std::vector<Sums> sums;
  sums.resize(pieces);
  Sums* const parts = sums.data();
  parallel_for(pieces, [&](int64_t piece) {
    const int64_t first = piece * kGrain;
    kernel(basis + first * rank, activations, gradient + first, std::min(kGrain, count - first),
           grad_basis + first * rank, parts[piece].data());
  });
  Sums total{};  // in the order of the values
  for (int64_t piece = 0; piece < pieces; ++piece) {
    for (int k = 0; k < rank; ++k) total[k] += parts[piece][k];
  }
  for (int k = 0; k < rank; ++k) grad_activations[k] = static_cast<float>(total[k]);
}

}  // namespace mien
