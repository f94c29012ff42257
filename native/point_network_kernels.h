// What point_network.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include <cstdint>

#include "point_network.h"

namespace mien {

constexpr int kPointBlock = 48;  // points that go through the network together

// Where the weights of one output are not zero: among the values of the previous layer, and among the extra ones.
struct WeightSpan {
  int begin, end, extra_begin, extra_end;
};

// A layer with its weights in the order in which kernels read them. Rows are padded with zeros to whole vectors, and
// strides are in floats. `extra` parts are null if there is none.
struct PaddedLayer {
  int outputs, extra;
  PointActivation activation;
  int64_t out_stride;
  int64_t kept;                         // where its rows of all points begin in what is kept
  const float *first, *extra_first;     // forward: [values it reads, out_stride]
  const float* bias;                    // [out_stride]
  const float *back, *extra_back;       // backward: [outputs, stride of the values it reads]
  int64_t sums, extra_sums, bias_sums;  // where its sums begin: as `back`, `extra_back` and `bias`
  const WeightSpan* spans;              // outputs: [outputs]
};
struct PaddedPoints {
  const PointNetwork* own;
  int64_t in_stride, scratch;  // floats of a thread's own memory
  PaddedLayer layers[kMostPointLayers];
};

struct PointKernels {
  // `scratch` holds `network.scratch` floats.
  void (*forward)(const PaddedPoints& network, float* kept, float* outputs, float* scratch, int64_t first, int64_t end);
  // The outputs alone, to the same bits. Reads spans and the network's own weights.
  void (*outputs)(const PaddedPoints& network, float* outputs, float* scratch, int64_t first, int64_t end);
  void (*backward)(const PaddedPoints& network, const float* kept, const float* by_outputs, float* by_inputs,
                   float* sums, float* scratch, int64_t first, int64_t end);
};

}  // namespace mien
