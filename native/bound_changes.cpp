#include "bound_changes.h"

#include <algorithm>
#include <vector>

#include "memory.h"
#include "pool.h"

namespace mien {

namespace {

constexpr int64_t kGrain = 4096;  // Gaussians in one piece of the pool's work

template <class Each>
void in_pieces(int64_t count, const Each& each) {
  parallel_for((count + kGrain - 1) / kGrain,
               [&](int64_t piece) { each(piece, piece * kGrain, std::min((piece + 1) * kGrain, count)); });
}

const float* activations_of(const ChangeBases& bases, int64_t index) {
  return bases.activations + bases.rows[index] * bases.width;
}

// `width` values of one Gaussian from its basis [width, r]. Sums run in the order of the activations, as in the
// runtime.
void linear_change(const ChangeBases& bases, const float* basis, int64_t index, int width, float* out) {
  const float *activations = activations_of(bases, index), *own = basis + index * width * bases.rank;
  for (int value = 0; value < width; ++value, own += bases.rank) {
    float sum = 0;
    for (int64_t k = 0; k < bases.rank; ++k) sum += own[k] * activations[k];
    out[index * width + value] = sum;
  }
}

double squares(const float* values, int64_t begin, int64_t end) {
  float lanes[8] = {};
  int64_t i = begin;
  for (; i + 8 <= end; i += 8)
    for (int lane = 0; lane < 8; ++lane) lanes[lane] += values[i + lane] * values[i + lane];
  double sum = 0;
  for (const float lane : lanes) sum += lane;
  for (; i < end; ++i) sum += static_cast<double>(values[i]) * values[i];
  return sum;
}

// The mean square of a change [n, width] in one piece; 0 without a change.
double share_of_mean(const float* values, int64_t begin, int64_t end, int width, int64_t count) {
  return values ? squares(values, begin * width, end * width) / static_cast<double>(count * width) : 0;
}

void add(const float* from, int64_t begin, int64_t end, float* to) {
  for (int64_t i = begin; from && i < end; ++i) to[i] += from[i];
}

// to = raw + (linear + features), in this order.
void join(const float* raw, const float* linear, const float* features, int64_t begin, int64_t end, float* to) {
  if (linear && features) {
    for (int64_t i = begin; i < end; ++i) to[i] = raw[i] + (linear[i] + features[i]);
    return;
  }
  const float* const change = linear ? linear : features;
  if (!change) {
    std::copy(raw + begin, raw + end, to + begin);
    return;
  }
  for (int64_t i = begin; i < end; ++i) to[i] = raw[i] + change[i];
}

// to = by_changed + by_change + factor * change.
void gradient_of_change(const float* by_changed, const float* by_change, const float* change, float factor,
                        int64_t begin, int64_t end, float* to) {
  for (int64_t i = begin; i < end; ++i) to[i] = (by_changed ? by_changed[i] : 0) + factor * change[i];
  add(by_change, begin, end, to);
}

void basis_gradient(const ChangeBases& bases, const float* gradient, int64_t begin, int64_t end, int width,
                    float* out) {
  for (int64_t index = begin; index < end; ++index) {
    const float* activations = activations_of(bases, index);
    for (int64_t value = index * width; value < (index + 1) * width; ++value)
      for (int64_t k = 0; k < bases.rank; ++k) out[value * bases.rank + k] = activations[k] * gradient[value];
  }
}

float factor_of(float by_squares, int64_t values) {
  return values == 0 ? 0 : 2 * by_squares / static_cast<float>(values);
}

}  // namespace

ChangeSquares change_gaussians(const ChangeBases& bases, const FeatureKept& kept, const RawGaussians<const float>& raw,
                               const GaussianChanges<float>& changes, const RawGaussians<float>& changed) {
  if (bases.network)
    feature_network(*bases.network, bases.features, kept, changes.feature_color, changes.feature_opacity);
  std::vector<ChangeSquares> sums((bases.count + kGrain - 1) / kGrain);
  in_pieces(bases.count, [&](int64_t piece, int64_t begin, int64_t end) {
    for (int64_t index = begin; index < end; ++index) {
      if (bases.offset) linear_change(bases, bases.offset, index, 3, changes.offset);
      if (bases.color) linear_change(bases, bases.color, index, 3, changes.color);
      if (bases.opacity) linear_change(bases, bases.opacity, index, 1, changes.opacity);
    }
    join(raw.means, changes.offset, nullptr, 3 * begin, 3 * end, changed.means);
    join(raw.opacity_logits, changes.opacity, changes.feature_opacity, begin, end, changed.opacity_logits);
    join(raw.sh, changes.color, changes.feature_color, 3 * begin, 3 * end, changed.sh);
    sums[piece].linear = share_of_mean(changes.offset, begin, end, 3, bases.count) +
                         share_of_mean(changes.color, begin, end, 3, bases.count) +
                         share_of_mean(changes.opacity, begin, end, 1, bases.count);
    sums[piece].features = share_of_mean(changes.feature_color, begin, end, 3, bases.count) +
                           share_of_mean(changes.feature_opacity, begin, end, 1, bases.count);
  });
  ChangeSquares whole{};
  for (const ChangeSquares& own : sums) whole.linear += own.linear, whole.features += own.features;
  return whole;
}

void change_gaussians_backward(const ChangeBases& bases, const FeatureKept& kept,
                               const GaussianChanges<const float>& changes, const ChangeGradients& gradients) {
  const int64_t n = bases.count;
  const GaussianChanges<const float>& by = gradients.changes;
  const float of_rows = factor_of(gradients.linear, 3 * n), of_numbers = factor_of(gradients.linear, n);
  const float of_feature_rows = factor_of(gradients.features, 3 * n);
  const float of_feature_numbers = factor_of(gradients.features, n);
  Recycled<float> scratch(4 * static_cast<size_t>(n));
  float *const rows = scratch.data(), *const numbers = rows + 3 * n;
  in_pieces(n, [&](int64_t, int64_t begin, int64_t end) {
    if (bases.offset) {
      gradient_of_change(gradients.changed.means, by.offset, changes.offset, of_rows, 3 * begin, 3 * end, rows);
      basis_gradient(bases, rows, begin, end, 3, gradients.offset_basis);
    }
    if (bases.color) {
      gradient_of_change(gradients.changed.sh, by.color, changes.color, of_rows, 3 * begin, 3 * end, rows);
      basis_gradient(bases, rows, begin, end, 3, gradients.color_basis);
    }
    if (bases.opacity) {
      gradient_of_change(gradients.changed.opacity_logits, by.opacity, changes.opacity, of_numbers, begin, end,
                         numbers);
      basis_gradient(bases, numbers, begin, end, 1, gradients.opacity_basis);
    }
    if (bases.network) {
      gradient_of_change(gradients.changed.sh, by.feature_color, changes.feature_color, of_feature_rows, 3 * begin,
                         3 * end, rows);
      gradient_of_change(gradients.changed.opacity_logits, by.feature_opacity, changes.feature_opacity,
                         of_feature_numbers, begin, end, numbers);
    }
  });
  if (!bases.network) return;
  // The network has no biases; what their gradients would be is not looked at.
  std::vector<float> biases(bases.network->hidden + bases.network->width);
  feature_network_backward(*bases.network, bases.features, kept,
                           {rows, numbers, gradients.by_features, gradients.weight1, biases.data(), gradients.weight2,
                            biases.data() + bases.network->hidden, nullptr, nullptr});
}

}  // namespace mien
