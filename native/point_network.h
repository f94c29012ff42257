// A dense network, the same for many points, whose layers may read an earlier layer a second time
// (src/mien/avatar/ops/point_network.py has the same in PyTorch).
#pragma once

#include <cstdint>

namespace mien {

constexpr int kMostPointLayers = 64;

enum class PointActivation { none, relu, softplus };  // softplus: ln(1 + exp(100 x)) / 100

// Values 0 are the inputs, values l + 1 those of layer l. Layer l reads values l, then values `extra`.
struct PointLayer {
  const float* weight;  // [outputs, width of values l, width of values extra]
  const float* bias;    // [outputs]
  int outputs;
  PointActivation activation;  // none for the last layer
  int extra;                   // less than l, or -1
};
struct PointNetwork {
  int64_t count;  // points
  int inputs;
  const float* values;  // [count, inputs]
  int layers;
  const PointLayer* items;
};

// Floats that the forward pass keeps of each point for the backward pass.
int64_t point_kept_floats(const PointNetwork& network);
// Fills outputs [count, outputs of the last layer], to the same bits with and without `kept`, which may be null. Runs
// on the pool.
void point_network(const PointNetwork& network, float* kept, float* outputs);

struct PointLayerGradients {
  float *weight, *bias;
};
struct PointGradients {
  const float* outputs;  // [count, outputs of the last layer]
  const PointLayerGradients* layers;
  float* inputs;  // [count, inputs], or null
};
// Points whose outputs have no gradient are not read. The result does not depend on the number of threads. Runs on the
// pool.
void point_network_backward(const PointNetwork& network, float* kept, const PointGradients& gradients);

}  // namespace mien
