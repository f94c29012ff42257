// What training.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include "training.h"

namespace mien {

struct TrainingKernels {
  // Elements, or Gaussians, first .. last - 1.
  void (*adam)(const AdamTask&, int64_t first, int64_t last);
  void (*factored_adam)(const FactoredAdamTask&, int64_t first, int64_t last);
  // `share` is 1 / number in view.
  Penalties (*penalties)(const PenaltyTask&, float share, int64_t first, int64_t last);
  void (*observe)(const ViewStatistics&, int64_t first, int64_t last);
  // Whether any of `count` values is not zero.
  bool (*any_nonzero)(const float* values, int64_t count);
  // The sum of (image - bytes / 255)^2 over `count` values.
  double (*squared_difference)(const float* image, const uint8_t* bytes, int64_t count);
  // The sum of |values - bytes / 255| over `count` values. Fills `gradient` with its sign times `share`.
  double (*absolute_difference)(const float* values, const uint8_t* bytes, float share, float* gradient, int64_t count);
};

}  // namespace mien
