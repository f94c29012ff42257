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
constexpr float kMargin = 0.1f;   // the same number as in Python

// Fills out [rank] with (inputs - rest) directions, and returns its length.
float project(const ActivationArrays& arrays, float* out) {
  float squares = 0;
  for (int64_t k = 0; k < arrays.rank; ++k) {
    float sum = 0;
    for (int64_t i = 0; i < arrays.inputs_count; ++i) {
      sum += (arrays.inputs[i] - arrays.rest[i]) * arrays.directions[i * arrays.rank + k];
    }
    out[k] = sum;
    squares += sum * sum;
  }
  return std::sqrt(std::max(squares, 1e-12f));
}

// The shorter length of activations that are `over` longer than the reach.
float shortened(const ActivationArrays& arrays, float over) {
  const float margin = kMargin * arrays.reach;
  return arrays.reach + margin * over / std::max(margin + over, 1e-6f);
}

}  // namespace

// No operation here may round in two ways, so these two use neither `exp` nor a kernel.
void expression_activations(const ActivationArrays& arrays, float* out) {
  const float length = project(arrays, out), over = length - arrays.reach;
  if (!(over > 0)) return;
  const float factor = shortened(arrays, over) / length;
  for (int64_t k = 0; k < arrays.rank; ++k) out[k] *= factor;
}

void expression_activations_backward(const ActivationArrays& arrays, const float* gradient, float* grad_inputs) {
  std::vector<float> values(arrays.rank), by_values(gradient, gradient + arrays.rank);
  const float length = project(arrays, values.data()), over = length - arrays.reach;
  if (over > 0) {
    // Along the activations, only the slope of the shorter length is left; across them, its share of the length.
    const float margin = kMargin * arrays.reach, sum = std::max(margin + over, 1e-6f);
    const float factor = shortened(arrays, over) / length, slope = margin / sum * (margin / sum);
    float along = 0;
    for (int64_t k = 0; k < arrays.rank; ++k) along += gradient[k] * values[k];
    const float share = (slope - factor) * along / (length * length);
    for (int64_t k = 0; k < arrays.rank; ++k) by_values[k] = factor * gradient[k] + share * values[k];
  }
  for (int64_t i = 0; i < arrays.inputs_count; ++i) {
    float sum = 0;
    for (int64_t k = 0; k < arrays.rank; ++k) sum += arrays.directions[i * arrays.rank + k] * by_values[k];
    grad_inputs[i] = sum;
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
