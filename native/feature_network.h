// HeadGaS' features (src/mien/avatar/ops/feature_network.py has the same in PyTorch): every Gaussian blends a basis of
// features by the inputs of a face, and a network of two layers, the same for all Gaussians, turns the blended features
// and some numbers of its own into outputs.
#pragma once

#include <cstdint>

namespace mien {

// The bases of n Gaussians, and the inputs of the face that weight them: those of the first row of `values`, or with
// `rows` [n] those of each Gaussian's own row.
struct FeatureInputs {
  const float* bases;   // [n, k, f]
  int64_t count;        // k
  const float* values;  // [.., k]
  const int64_t* rows = nullptr;

  const float* values_of(int64_t index) const { return values + (rows ? rows[index] * count : 0); }
};

struct FeatureNetwork {
  int64_t count;                     // n Gaussians
  int features, own, hidden, width;  // f, x, h, o; at least one of each but x
  const float* neutral;              // [n, f], added to the blended features
  const float* owns;                 // [n, x], numbers of each Gaussian that go into the network beside its features
  const float *weight1, *bias1;      // [h, f + x], [h]; leaky ReLU of slope 0.01 after it
  const float *weight2, *bias2;      // [o, h], [o]
};
// Floats in one row of the hidden values that the forward pass keeps.
int64_t hidden_stride(int hidden);

// What the backward pass needs; null if there is none.
struct FeatureKept {
  float* features;  // [n, f]
  float* hidden;    // [n, hidden_stride]
};
// Fills all outputs but the last [n, o - 1], and the last [n]. Inputs that are 0 for all are not read. Runs on the
// pool.
void feature_network(const FeatureNetwork& network, const FeatureInputs& inputs, const FeatureKept& kept,
                     float* outputs, float* last);

struct FeatureGradients {
  const float* outputs;  // [n, o - 1]
  const float* last;     // [n]
  float* features;       // [n, f], written: also the gradient of `neutral`
  float *weight1, *bias1, *weight2, *bias2;
  float* inputs;  // one per input, or null, as it must be with rows
  float* owns;    // [n, x], or null
};
// Gaussians whose outputs have no gradient are not read. The gradient of the bases is never made: that of input k's
// column is its value times `features`. The result does not depend on the number of threads. Runs on the pool.
void feature_network_backward(const FeatureNetwork& network, const FeatureInputs& inputs, const FeatureKept& kept,
                              const FeatureGradients& gradients);

// Adam without a first moment and with one second moment per row of factors, for values [n, k, f] whose gradient is a
// sum of outer products. Each term has `rows` [n, f] and `columns` [k], or with `places` [n] a table of them [.., k].
struct FactoredTerm {
  const float* rows;
  const float* columns;
  const int64_t* places = nullptr;

  const float* columns_of(int64_t index, int count) const { return columns + (places ? places[index] * count : 0); }
};
struct FactoredUpdate {
  float* values;
  int64_t count;
  int columns_count, width;
  const FactoredTerm* terms;
  int terms_count;
  float* second;   // [n, f], running mean of the squared gradient, which is itself a mean over the columns
  float* weights;  // [n], running mean of 1, for bias correction: how much of `second` is filled
  float rate;
};
// Gaussians whose rows of factors or columns are all 0 keep their values and moments. Columns that are 0 in all terms
// are neither read nor written. Runs on the pool.
void factored_update(const FactoredUpdate& task);

}  // namespace mien
