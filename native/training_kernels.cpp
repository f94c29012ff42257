// Compiled once per instruction set.
#include "training_kernels.h"

#include "simd_columns.h"

namespace mien::MIEN_ISA {
namespace {

// The first `valid` floats; zeros beyond.
MIEN_INLINE F load_some(const float* from, int64_t valid) {
  if (valid >= W) return load(from);
  F value{};
  for (int lane = 0; lane < valid; ++lane) value[lane] = from[lane];
  return value;
}
MIEN_INLINE void store_some(float* to, int64_t valid, F value) {
  if (valid >= W) {
    store(to, value);
  } else {
    for (int lane = 0; lane < valid; ++lane) to[lane] = value[lane];
  }
}

// One vector of a tensor at place i, whose gradient is g.
template <class Task>
MIEN_INLINE void adam_vector(const Task& task, const AdamDecays& decays, int64_t i, int64_t valid, F g) {
  const F beta1 = set1(decays.first), beta2 = set1(decays.second);
  F first = load_some(task.first + i, valid), second = load_some(task.second + i, valid);
  first = first * beta1 + g * (1.0f - decays.first);
  second = second * beta2 + g * g * (1.0f - decays.second);
  const F denominator = square_root(second) * task.second_unbiased + kAdamEpsilon;
  store_some(task.first + i, valid, first);
  store_some(task.second + i, valid, second);
  const F value = load_some(task.values + i, valid);
  store_some(task.values + i, valid, value - task.step_size * first / denominator);
}

void adam(const AdamTask& task, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; i += W) {
    adam_vector(task, task.decays, i, end - i, load_some(task.gradient + i, end - i));
  }
}

void factored_adam(const FactoredAdamTask& task, int64_t begin, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;  // running means of gradients that have ended approach 0
  for (int64_t index = begin; index < end; ++index) {
    for (int k = 0; k < task.columns_count; ++k) {
      const int64_t at = (index * task.columns_count + k) * task.width;
      for (int i = 0; i < task.width; i += W) {
        F g{};
        for (int t = 0; t < task.terms_count; ++t) {
          g = g + load_some(task.terms[t].rows + index * task.width + i, task.width - i) *
                      task.terms[t].columns_of(index, task.columns_count)[k];
        }
        adam_vector(task, {}, at + i, task.width - i, g);
      }
    }
  }
}

MIEN_INLINE F exponential(F a) { return exp2_fast(clamp(a * 1.44269504f, set1(-99.0f), set1(99.0f))); }

// The length of a vector, and 1 / length (0 for a zero vector).
MIEN_INLINE F length(const F* v, F* inverse) {
  const F squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
  const M there = less(set1(1e-30f), squared);
  const F root = square_root(squared);
  *inverse = keep(there, 1.0f / select(there, root, set1(1.0f)));
  return root;
}

Penalties penalties(const PenaltyTask& task, float share, int64_t begin, int64_t end) {
  F position{}, scale{};
  const F position_share = set1(share * task.position_weight), scale_share = set1(share * task.scale_weight);
  for (int64_t i = begin; i < end; i += W) {
    const int valid = end - i < W ? (int)(end - i) : W;
    F in_view{};
    for (int lane = 0; lane < valid; ++lane) in_view[lane] = task.radii[i + lane] > 0 ? 1.0f : 0.0f;
    F mean[3], log_scale[3], inverse;
    load_columns<3>(task.means + 3 * i, 3, valid, mean);
    const F too_far = maximum(length(mean, &inverse) - task.position_threshold, F{});
    position = position + too_far * in_view;
    const F pull = keep(less(F{}, too_far), inverse * in_view * position_share);
    const F grad_mean[3] = {pull * mean[0], pull * mean[1], pull * mean[2]};
    store_columns<3>(task.grad_means + 3 * i, 3, valid, grad_mean);

    load_columns<3>(task.log_scales + 3 * i, 3, valid, log_scale);
    F local[3], excess[3];
    for (int axis = 0; axis < 3; ++axis) {
      local[axis] = exponential(log_scale[axis]);
      excess[axis] = maximum(local[axis] - task.scale_threshold, F{});
    }
    scale = scale + length(excess, &inverse) * in_view;
    const F shrink = inverse * in_view * scale_share;
    const F grad_scale[3] = {shrink * excess[0] * local[0], shrink * excess[1] * local[1],
                             shrink * excess[2] * local[2]};
    store_columns<3>(task.grad_log_scales + 3 * i, 3, valid, grad_scale);
  }
  return {sum(position), sum(scale)};
}

void observe(const ViewStatistics& task, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    const float x = task.grad_means2d[2 * i] * task.scale_x, y = task.grad_means2d[2 * i + 1] * task.scale_y;
    task.pull[i] += __builtin_sqrtf(x * x + y * y);
    const int32_t radius = task.radii[i];
    task.seen[i] += radius > 0 ? 1.0f : 0.0f;
    task.radius[i] = radius > task.radius[i] ? radius : task.radius[i];
    task.opacity[i] = task.opacities[i] > task.opacity[i] ? task.opacities[i] : task.opacity[i];
  }
}

bool any_nonzero(const float* values, int64_t count) {
  int64_t i = 0;
  for (; i + 4 * W <= count; i += 4 * W) {
    I seen{};
    for (int v = 0; v < 4; ++v) seen = seen | bits(load(values + i + v * W));
    if (any(less(F{}, to_float(seen & 0x7fffffff)))) return true;
  }
  for (; i < count; ++i)
    if (values[i] != 0) return true;
  return false;
}

double squared_difference(const float* image, const uint8_t* bytes, int64_t count) {
  F sums{};
  int64_t i = 0;
  for (; i + W <= count; i += W) {
    F target;
    for (int lane = 0; lane < W; ++lane) target[lane] = (float)bytes[i + lane];
    const F difference = load(image + i) - target * (1.0f / 255);
    sums = sums + difference * difference;
  }
  double total = sum(sums);
  for (; i < count; ++i) {
    const float difference = image[i] - (float)bytes[i] * (1.0f / 255);
    total += difference * difference;
  }
  return total;
}

double absolute_difference(const float* values, const uint8_t* bytes, float share, float* gradient, int64_t count) {
  F sums{};
  const F up = set1(share);
  for (int64_t i = 0; i < count; i += W) {
    const int64_t valid = count - i;
    F target{};
    for (int lane = 0; lane < W && lane < valid; ++lane) target[lane] = (float)bytes[i + lane];
    // Rounded, or else equal values would differ by what the product is rounded by.
    const F difference = load_some(values + i, valid) - rounded(target * (1.0f / 255));
    sums = sums + maximum(difference, -difference);
    store_some(gradient + i, valid, keep(less(F{}, difference), up) - keep(less(difference, F{}), up));
  }
  return sum(sums);
}

}  // namespace

extern const TrainingKernels training_kernels;
const TrainingKernels training_kernels = {adam,        factored_adam,      penalties,          observe,
                                          any_nonzero, squared_difference, absolute_difference};

}  // namespace mien::MIEN_ISA
