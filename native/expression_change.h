// Changes of Gaussians with the expression, of low rank (src/mien/avatar/ops/expression_changes.py has the same in
// PyTorch).
#pragma once

#include <cstdint>
#include <vector>

namespace mien {

// Activations along directions: (inputs - rest) directions, each block of them softly shortened to how far training saw
// faces go that way.
struct ActivationArrays {
  std::vector<float> rest;        // [inputs]
  std::vector<float> directions;  // [inputs, rank]
  std::vector<float> seen;        // [.., rank]: activations that training saw; none shortens nothing
  int64_t rank, block;            // block: the number of activations that are shortened together; it divides rank
};

// Activations of a face's triangles: of the regions, a block of `own` for each, and of the pose of the head.
struct FaceActivations {
  ActivationArrays own;
  std::vector<float> head_rest;  // [6], an axis-angle vector, then the place in metres; empty without a pose
  ActivationArrays head;         // of the head's motion [6]
  std::vector<float> shares;     // [rows, regions]; empty if the face is one region

  int64_t regions() const { return own.rank / own.block; }
  int64_t width() const { return own.block + (head_rest.empty() ? 0 : head.rank); }
  int64_t rows() const { return shares.empty() ? 1 : static_cast<int64_t>(shares.size()) / regions(); }
};
// Fills out [rows, width]: activations of the face and of the head in turn, as long as there are both. `inputs` are
// expression coefficients, then joints; `pose` [6] is that of the head. Sums run in the order of the inputs, so that
// training and the runtime get the same bits.
void activation_table(const FaceActivations& face, const float* inputs, const float* pose, float* out);

// Bases [count, values, rank] of Gaussians, each with the first numbers of a row of activations [.., width]: that of
// `rows` [count], or the first if it is null.
struct ExpressionBases {
  int64_t count, values, rank, width;
  const float* activations;
  const int64_t* rows;
};
// Fills out [count, values], the sums of the bases' columns weighted by the activations. Runs on the pool.
void expression_change(const ExpressionBases& bases, const float* basis, float* out);

}  // namespace mien
