// What a training step does to every Gaussian outside of the rasterizer and the rig: its update, its penalties, its
// statistics. Each is one pass over memory; src/mien/{training,avatar} have the same in plain PyTorch.
#pragma once

#include <cstdint>

#include "feature_network.h"

namespace mien {

// Decays of Adam's running means per update.
struct AdamDecays {
  float first = 0.9f, second = 0.999f;
};

// One tensor's update by Adam (Kingma and Ba 2015).
struct AdamTask {
  float* values;
  const float* gradient;
  float* first;   // running mean of the gradient
  float* second;  // running mean of its square
  int64_t count;
  float step_size;        // rate / (1 - beta1^t)
  float second_unbiased;  // 1 / sqrt(1 - beta2^t)
  AdamDecays decays;
};
constexpr float kAdamEpsilon = 1e-15f;

void adam_update(const AdamTask* tasks, int count);

// The sums of two arrays each, in an array of their own.
struct SumTask {
  const float *first, *second;
  float* sum;
  int64_t count;
};
void add_arrays(const SumTask* tasks, int count);

// The same for values [n, k, f] whose gradient is a sum of outer products, so that it is never made. With one product,
// bits are those of `adam_update` with that gradient, but for numbers below 1.2e-38, which become 0.
struct FactoredAdamTask {
  float* values;
  const FactoredTerm* terms;
  float *first, *second;  // [n, k, f]
  int64_t count;
  int columns_count, width, terms_count;
  float step_size, second_unbiased;
};
void factored_adam_update(const FactoredAdamTask& task);

// Penalties on Gaussians that stray from their triangle (GaussianAvatars, section 3.4), means over those in view:
// max(|mean| - position_threshold, 0) and |max(exp(log_scales) - scale_threshold, 0)|, each times its weight.
struct PenaltyTask {
  int64_t count;
  const float* means;       // [n,3], triangle units
  const float* log_scales;  // [n,3]
  const int32_t* radii;     // [n], 0 where not in view
  float position_threshold, position_weight;
  float scale_threshold, scale_weight;
  float* grad_means;  // [n,3], written
  float* grad_log_scales;
};
struct Penalties {
  double position, scale;
};
Penalties triangle_penalties(const PenaltyTask& task);

// Adds a step to the statistics of density control.
struct ViewStatistics {
  int64_t count;
  const float* grad_means2d;  // [n,2], per pixel
  const int32_t* radii;       // [n]
  const float* opacities;     // [n]
  float scale_x, scale_y;     // pixels to the unit of `pull`
  float* pull;                // [n], sum of the gradients' lengths
  float* seen;                // [n], in how many steps it was in view
  int32_t* radius;            // [n], the largest yet
  float* opacity;             // [n], the highest yet
};
void observe_view(const ViewStatistics& task);

// Left, top, right and bottom (the latter two outside) of the values that are not zero; all 0 where there are none.
struct PixelBox {
  int left, top, right, bottom;
};
PixelBox box_of_nonzero(const float* values, int width, int height);

// The mean of (image - bytes / 255)^2 over all values of a picture.
double mean_squared_difference(const float* image, const uint8_t* bytes, int64_t count);

// `weight` times the mean of |values - bytes / 255|, and its gradient, which is written. Runs on the pool.
double absolute_difference(const float* values, const uint8_t* bytes, int64_t count, float weight, float* gradient);

// The same of colours [pixels, 3], where differences up to `free` cost nothing. Only `counted` pixels add to the mean,
// which is over all of them; null stands for all. Runs on the pool.
struct ColorDifference {
  const float* image;
  const uint8_t *bytes, *counted;
  int64_t pixels;
  float weight, free;
  float* gradient;
};
double color_difference(const ColorDifference& task);

}  // namespace mien
