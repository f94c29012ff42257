// Changes of Gaussians with the expression, of low rank (src/mien/avatar/ops/expression_changes.py has the same in
// PyTorch).
#pragma once

#include <cstdint>

namespace mien {

// Activations of one face: (inputs - rest) directions, each block of them softly shortened to how far training saw
// faces go that way.
struct ActivationArrays {
  const float* inputs;  // [inputs_count]
  int64_t inputs_count;
  const float* rest;        // [inputs_count]
  const float* directions;  // [inputs_count, rank]
  int64_t rank, block;      // block: the number of activations that are shortened together; it divides rank
  const float* seen;        // [seen_count, rank]: activations that training saw; none shortens nothing
  int64_t seen_count;
};
// Fills out [rank]. Sums run in the order of the inputs, so that training and the runtime get the same bits.
void expression_activations(const ActivationArrays& arrays, float* out);

// How the head moved: the sines of its turns about its own axes at rest, and its shift along them, in metres. Poses are
// an axis-angle vector, then the place.
void head_motion(const float* rest, const float* pose, float* out);

// out [rows, width] = shares [rows, regions] table [regions, width], in the order of the regions.
void blend_regions(const float* shares, const float* table, int64_t rows, int64_t regions, int64_t width, float* out);

// Bases [count, values, rank] of Gaussians, each with a row of activations [.., rank]: that of `rows` [count], or the
// first if it is null.
struct ExpressionBases {
  int64_t count, values, rank;
  const float* activations;
  const int64_t* rows;
};
// Fills out [count, values], the sums of the bases' columns weighted by the activations. Runs on the pool.
void expression_change(const ExpressionBases& bases, const float* basis, float* out);

// Fills the gradient of the bases. Runs on the pool.
void expression_change_backward(const ExpressionBases& bases, const float* gradient, float* grad_basis);

}  // namespace mien
