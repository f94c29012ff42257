// Changes of bound Gaussians with the activations of a face, beside those of the mesh, in one pass each way
// (src/mien/avatar/gaussian_avatars/changes.py has the same in PyTorch): linear ones by bases, and those of features.
#pragma once

#include <cstdint>

#include "feature_network.h"

namespace mien {

// Changes of n Gaussians, or gradients of them. Each may be null.
template <typename T>
struct GaussianChanges {
  T* offset;           // [n, 3], of the centre in the triangle's frame and units
  T* color;            // [n, 3], of the first SH coefficient
  T* opacity;          // [n], of the raw opacity
  T* feature_color;    // [n, 3]
  T* feature_opacity;  // [n]
};

// Each of the first three may be null: then nothing changes linearly. `network` is null without features.
struct ChangeBases {
  int64_t count, rank;       // n, and r: the number of activations that the bases take, the first of a row
  const float* offset;       // [n, 3, r]
  const float* color;        // [n, 3, r]
  const float* opacity;      // [n, r]
  const float* activations;  // [.., width]
  int64_t width;
  const int64_t* rows;  // [n]
  const FeatureNetwork* network;
  FeatureInputs features;
};

// What changes: centres [n, 3], raw opacities [n] and first SH coefficients [n, 3].
template <typename T>
struct RawGaussians {
  T *means, *opacity_logits, *sh;
};

// Sums of squares of the changes: of the linear ones, and of the features'. Each is divided by the number of values.
struct ChangeSquares {
  double linear, features;
};

// Fills the changes and the changed Gaussians. Linear changes and features' are added up before they join a value.
// Runs on the pool; the result does not depend on the number of threads.
ChangeSquares change_gaussians(const ChangeBases& bases, const FeatureKept& kept, const RawGaussians<const float>& raw,
                               const GaussianChanges<float>& changes, const RawGaussians<float>& changed);

struct ChangeGradients {
  RawGaussians<const float> changed;                  // of the changed Gaussians; sh may be null
  GaussianChanges<const float> changes;               // of the changes themselves; each may be null
  float linear, features;                             // of the two sums of squares
  float *offset_basis, *color_basis, *opacity_basis;  // written, as far as there are such bases
  float *by_features, *weight1, *weight2;             // the same, of the features and of the network's two layers
};
// Fills the gradients, from the changes that `change_gaussians` filled.
void change_gaussians_backward(const ChangeBases& bases, const FeatureKept& kept,
                               const GaussianChanges<const float>& changes, const ChangeGradients& gradients);

}  // namespace mien
