// What feature_network.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include <cstdint>

#include "feature_network.h"

namespace mien {

constexpr int kFeatureBlock = 48;  // Gaussians that go through the network together

// The network with its weights in the order in which kernels read them. Rows are padded with zeros to whole vectors.
struct PaddedNetwork {
  const FeatureNetwork* own;
  int64_t in_stride, feature_stride, hidden_stride, out_stride;
  const float *first, *first_bias;    // [f + x, hidden_stride], [hidden_stride]
  const float *second, *second_bias;  // [h, out_stride], [out_stride]
  const float* second_back;           // [o, hidden_stride]
  const float* first_back;            // [h, feature_stride]: of the features, then of own numbers if that is asked for
};

// Sums over the Gaussians of a piece: rows padded as above. `inputs` has 16 parts per input.
struct FeatureSums {
  float *first, *first_bias;    // [h, in_stride], [hidden_stride]
  float *second, *second_bias;  // [o, hidden_stride], [out_stride]
  float* inputs;
};

// The inputs that are read.
struct UsedInputs {
  const int64_t* items;
  int64_t count;
};

struct FeatureKernels {
  // `scratch` holds kFeatureBlock rows of each stride.
  void (*forward)(const PaddedNetwork& network, const FeatureInputs& inputs, const UsedInputs& used,
                  const FeatureKept& kept, float* outputs, float* last, float* scratch, int64_t first, int64_t end);
  void (*backward)(const PaddedNetwork& network, const FeatureInputs& inputs, const FeatureKept& kept,
                   const FeatureGradients& gradients, const FeatureSums& sums, float* scratch, int64_t first,
                   int64_t end);
  // `products` has room for [t, t] numbers, `steps` for t rows of factors.
  void (*update)(const FactoredUpdate& task, float* products, float* steps, int64_t first, int64_t end);
};

}  // namespace mien
