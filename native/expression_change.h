// Changes of Gaussians with the expression, of low rank (src/mien/avatar/ops/expression_changes.py has the same in
// PyTorch).
#pragma once

#include <cstdint>

namespace mien {

constexpr int kMostExpressionRank = 8;

// The activations of one face: (inputs - rest) directions, softly shortened to how far training saw faces go that way.
struct ActivationArrays {
  const float* inputs;  // [inputs_count]
  int64_t inputs_count;
  const float* rest;        // [inputs_count]
  const float* directions;  // [inputs_count, rank]
  int64_t rank;
  const float* seen;  // [seen_count, rank]: activations that training saw; none shortens nothing
  int64_t seen_count;
};
// Fills out [rank]. Sums run in the order of the inputs, so that training and the runtime get the same bits.
void expression_activations(const ActivationArrays& arrays, float* out);
// Fills the gradient of the inputs, given that of the activations [rank].
void expression_activations_backward(const ActivationArrays& arrays, const float* gradient, float* grad_inputs);

// out [count] = basis [count, rank] activations [rank], with a rank of 1 to 8. Runs on the pool.
void expression_change(const float* basis, const float* activations, int rank, int64_t count, float* out);

// Fills the gradients of the basis and of the activations. The result does not depend on the number of threads. Runs on
// the pool.
void expression_change_backward(const float* basis, const float* activations, const float* gradient, int rank,
                                int64_t count, float* grad_basis, float* grad_activations);

}  // namespace mien
