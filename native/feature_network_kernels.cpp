// Compiled once per instruction set: products of small matrices, a block of Gaussians at a time.
#include "feature_network_kernels.h"

#include "simd.h"
#include "small_matrix.h"

namespace mien::MIEN_ISA {
namespace {

constexpr float kSlope = 0.01f;
constexpr int64_t kAhead = 6;  // how many Gaussians before their turn bases are fetched from memory

MIEN_INLINE void prefetch(const float* from, int64_t count) {
  for (int64_t i = 0; i < count; i += 16) __builtin_prefetch(from + i);
}

MIEN_INLINE void add_scaled(const float* from, float factor, int width, float* to) {
  int i = 0;
  for (; i + W <= width; i += W) store(to + i, load(to + i) + factor * load(from + i));
  for (; i < width; ++i) to[i] += factor * from[i];
}

// As `add_scaled` for all inputs of one Gaussian, with the sums in registers.
template <int V>
MIEN_INLINE void blend_vectors(const float* rows, const float* values, const UsedInputs& used, int width, float* to) {
  F sums[V];
  for (int v = 0; v < V; ++v) sums[v] = load(to + v * W);
  for (int64_t u = 0; u < used.count; ++u) {
    const int64_t k = used.items[u];
    for (int v = 0; v < V; ++v) sums[v] = sums[v] + values[k] * load(rows + k * width + v * W);
  }
  for (int v = 0; v < V; ++v) store(to + v * W, sums[v]);
}

// The blended features of a block go into the first columns of `rows`.
void blend(const PaddedNetwork& network, const FeatureInputs& inputs, const UsedInputs& used, int64_t first,
           int64_t count, float* rows) {
  const int width = network.own->features;
  for (int64_t index = first; index < first + count; ++index, rows += network.in_stride) {
    const float *own = inputs.bases + index * inputs.count * width, *values = inputs.values_of(index);
    if (index + kAhead < network.own->count) prefetch(own + kAhead * inputs.count * width, inputs.count * width);
    copy(rows, network.own->neutral + index * width, width);
    int i = 0;
    for (; i + 2 * W <= width; i += 2 * W) blend_vectors<2>(own + i, values, used, width, rows + i);
    for (; i + W <= width; i += W) blend_vectors<1>(own + i, values, used, width, rows + i);
    for (; i < width; ++i)
      for (int64_t u = 0; u < used.count; ++u) rows[i] += values[used.items[u]] * own[used.items[u] * width + i];
  }
}

// The columns beyond the features: the Gaussian's own numbers, then zeros.
MIEN_INLINE void fill_own(const PaddedNetwork& network, int64_t index, float* row) {
  const int features = network.own->features, own = network.own->own;
  for (int c = 0; c < own; ++c) row[features + c] = network.own->owns[index * own + c];
  for (int64_t c = features + own; c < network.in_stride; ++c) row[c] = 0;
}

void forward(const PaddedNetwork& network, const FeatureInputs& inputs, const UsedInputs& used, const FeatureKept& kept,
             float* outputs, float* last, float* scratch, int64_t first, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;
  const FeatureNetwork& own = *network.own;
  float* const rows = scratch;
  float* const values = rows + kFeatureBlock * network.in_stride;
  float* const out = values + kFeatureBlock * network.hidden_stride;
  for (int64_t begin = first; begin < end; begin += kFeatureBlock) {
    const int64_t count = end - begin < kFeatureBlock ? end - begin : kFeatureBlock;
    blend(network, inputs, used, begin, count, rows);
    for (int64_t i = 0; i < count; ++i) {
      float* const row = rows + i * network.in_stride;
      fill_own(network, begin + i, row);
      if (kept.features) copy(kept.features + (begin + i) * own.features, row, own.features);
    }
    float* const hidden = kept.hidden ? kept.hidden + begin * network.hidden_stride : values;
    multiply({rows, network.in_stride, 1}, count, network.first, network.hidden_stride, own.features + own.own,
             network.first_bias, 0, hidden);
    for (int64_t i = 0; i < count * network.hidden_stride; i += W) {
      const F value = load(hidden + i);
      store(hidden + i, maximum(value, kSlope * value));
    }
    multiply({hidden, network.hidden_stride, 1}, count, network.second, network.out_stride, own.hidden,
             network.second_bias, 0, out);
    for (int64_t i = 0; i < count; ++i) {
      const float* row = out + i * network.out_stride;
      copy(outputs + (begin + i) * (own.width - 1), row, own.width - 1);
      last[begin + i] = row[own.width - 1];
    }
  }
}

MIEN_INLINE F dot(const float* a, const float* b, int width) {
  F total{};
  int i = 0;
  for (; i + W <= width; i += W) total = total + load(a + i) * load(b + i);
  for (; i < width; ++i) total[0] += a[i] * b[i];
  return total;
}

// A block of Gaussians that have gradients: their indices and, in scratch, their rows.
struct Block {
  int64_t index[kFeatureBlock];
  int64_t count = 0;
  float *rows, *hidden, *by_out, *by_hidden, *by_features;
};

void gather(const PaddedNetwork& network, const FeatureKept& kept, const FeatureGradients& gradients, int64_t index,
            Block& block) {
  const FeatureNetwork& own = *network.own;
  const int64_t i = block.count++;
  block.index[i] = index;
  float* const row = block.rows + i * network.in_stride;
  copy(row, kept.features + index * own.features, own.features);
  fill_own(network, index, row);
  copy(block.hidden + i * network.hidden_stride, kept.hidden + index * network.hidden_stride, network.hidden_stride);
  float* const by_out = block.by_out + i * network.out_stride;
  copy(by_out, gradients.outputs + index * (own.width - 1), own.width - 1);
  by_out[own.width - 1] = gradients.last[index];
  for (int64_t c = own.width; c < network.out_stride; ++c) by_out[c] = 0;
}

void backward_block(const PaddedNetwork& network, const FeatureInputs& inputs, const FeatureGradients& gradients,
                    const FeatureSums& sums, const float* zeros, Block& block) {
  const FeatureNetwork& own = *network.own;
  multiply({block.by_out, network.out_stride, 1}, block.count, network.second_back, network.hidden_stride, own.width,
           zeros, 0, block.by_hidden);
  for (int64_t i = 0; i < block.count * network.hidden_stride; i += W) {
    const F gradient = load(block.by_hidden + i);
    store(block.by_hidden + i, select(less(F{}, load(block.hidden + i)), gradient, kSlope * gradient));
  }
  multiply({block.by_hidden, network.hidden_stride, 1}, block.count, network.first_back, network.feature_stride,
           own.hidden, zeros, 0, block.by_features);
  multiply({block.by_out, 1, network.out_stride}, own.width, block.hidden, network.hidden_stride, block.count,
           sums.second, network.hidden_stride, sums.second);
  multiply({block.by_hidden, 1, network.hidden_stride}, own.hidden, block.rows, network.in_stride, block.count,
           sums.first, network.in_stride, sums.first);
  add_rows(block.by_out, block.count, network.out_stride, sums.second_bias);
  add_rows(block.by_hidden, block.count, network.hidden_stride, sums.first_bias);
  for (int64_t i = 0; i < block.count; ++i) {
    const float* by_features = block.by_features + i * network.feature_stride;
    copy(gradients.features + block.index[i] * own.features, by_features, own.features);
    if (gradients.owns) copy(gradients.owns + block.index[i] * own.own, by_features + own.features, own.own);
    if (!gradients.inputs) continue;
    for (int64_t k = 0; k < inputs.count; ++k) {
      const float* row = inputs.bases + (block.index[i] * inputs.count + k) * own.features;
      store(sums.inputs + 16 * k, load(sums.inputs + 16 * k) + dot(row, by_features, own.features));
    }
  }
  block.count = 0;
}

void backward(const PaddedNetwork& network, const FeatureInputs& inputs, const FeatureKept& kept,
              const FeatureGradients& gradients, const FeatureSums& sums, float* scratch, int64_t first, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;
  const FeatureNetwork& own = *network.own;
  Block block;
  block.rows = scratch;
  block.hidden = block.rows + kFeatureBlock * network.in_stride;
  block.by_out = block.hidden + kFeatureBlock * network.hidden_stride;
  block.by_hidden = block.by_out + kFeatureBlock * network.out_stride;
  block.by_features = block.by_hidden + kFeatureBlock * network.hidden_stride;
  float* const zeros = block.by_features + kFeatureBlock * network.feature_stride;
  memset(zeros, 0, sizeof(float) * (network.hidden_stride + network.feature_stride));
  for (int64_t index = first; index < end; ++index) {
    if (gradients.last[index] == 0 && all_zero(gradients.outputs + index * (own.width - 1), own.width - 1)) {
      memset(gradients.features + index * own.features, 0, sizeof(float) * own.features);
      if (gradients.owns) memset(gradients.owns + index * own.own, 0, sizeof(float) * own.own);
      continue;
    }
    gather(network, kept, gradients, index, block);
    if (block.count == kFeatureBlock) backward_block(network, inputs, gradients, sums, zeros, block);
  }
  if (block.count > 0) backward_block(network, inputs, gradients, sums, zeros, block);
}

MIEN_INLINE float not_below_zero(float a) { return a > 0 ? a : 0; }
MIEN_INLINE F not_below_zero(F a) { return maximum(a, F{}); }

// The squared gradient of some factors of one Gaussian, as a mean over the columns. `at` is the place of the factors.
// Terms that cancel may leave less than 0 by rounding.
template <class Vector, class Load>
MIEN_INLINE Vector mean_square(const FactoredUpdate& task, const float* products, int64_t at, Load load_at) {
  Vector total{};
  for (int s = 0; s < task.terms_count; ++s) {
    const Vector factor = load_at(task.terms[s].rows + at);
    total = total + factor * factor * products[s * task.terms_count + s];
    for (int t = 0; t < s; ++t)
      total = total + factor * load_at(task.terms[t].rows + at) * (2 * products[s * task.terms_count + t]);
  }
  return not_below_zero(total);
}

// The steps of all factors of one Gaussian, a row for each term, and its moments.
MIEN_INLINE void factor_steps(const FactoredUpdate& task, const float* products, int64_t index, float* steps) {
  const float beta = 0.999f, rest = 0.001f, weight = task.weights[index] * beta + rest;
  task.weights[index] = weight;
  const float unbiased = 1 / weight;
  const int64_t begin = index * task.width;
  float* second = task.second + begin;
  int i = 0;
  for (; i + W <= task.width; i += W) {
    const F square = mean_square<F>(task, products, begin + i, [](const float* from) { return load(from); });
    const F mean = load(second + i) * beta + square;
    store(second + i, mean);
    const F deviation = square_root(mean * unbiased) + 1e-15f;
    for (int t = 0; t < task.terms_count; ++t)
      store(steps + t * task.width + i, task.rate * load(task.terms[t].rows + begin + i) / deviation);
  }
  for (; i < task.width; ++i) {
    second[i] =
        second[i] * beta + mean_square<float>(task, products, begin + i, [](const float* from) { return *from; });
    const float deviation = __builtin_sqrtf(second[i] * unbiased) + 1e-15f;
    for (int t = 0; t < task.terms_count; ++t)
      steps[t * task.width + i] = task.rate * task.terms[t].rows[begin + i] / deviation;
  }
}

// Whether each term's rows or columns are all 0.
MIEN_INLINE bool untouched(const FactoredUpdate& task, const float* products, int64_t index) {
  for (int t = 0; t < task.terms_count; ++t) {
    const bool has_columns = products[t * (task.terms_count + 1)] > 0;
    if (has_columns && !all_zero(task.terms[t].rows + index * task.width, task.width)) return false;
  }
  return true;
}

// The means of the products of two terms' columns, times 1 - beta2 of Adam.
MIEN_INLINE void fill_products(const FactoredUpdate& task, int64_t index, float* products) {
  const int terms = task.terms_count, count = task.columns_count;
  for (int s = 0; s < terms; ++s) {
    const float* one = task.terms[s].columns_of(index, count);
    for (int t = 0; t <= s; ++t) {
      const float* other = task.terms[t].columns_of(index, count);
      float product = 0;
      for (int k = 0; k < count; ++k) product += one[k] * other[k];
      products[s * terms + t] = 0.001f * product / static_cast<float>(count > 0 ? count : 1);
    }
  }
}

void update(const FactoredUpdate& task, float* products, float* steps, int64_t first, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;
  bool by_row = false;
  for (int t = 0; t < task.terms_count; ++t) by_row = by_row || task.terms[t].places;
  if (!by_row) fill_products(task, 0, products);
  for (int64_t index = first; index < end; ++index) {
    if (by_row) fill_products(task, index, products);
    if (untouched(task, products, index)) continue;
    factor_steps(task, products, index, steps);
    float* values = task.values + index * task.columns_count * task.width;
    const int64_t floats = static_cast<int64_t>(task.columns_count) * task.width;
    if (index + kAhead < task.count) prefetch(values + kAhead * floats, floats);
    for (int k = 0; k < task.columns_count; ++k, values += task.width) {
      for (int t = 0; t < task.terms_count; ++t) {
        const float column = task.terms[t].columns_of(index, task.columns_count)[k];
        if (column != 0) add_scaled(steps + t * task.width, -column, task.width, values);
      }
    }
  }
}

}  // namespace

extern const FeatureKernels feature_kernels;
const FeatureKernels feature_kernels = {forward, backward, update};

}  // namespace mien::MIEN_ISA
