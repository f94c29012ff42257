// Compiled once per instruction set: a block of points at a time, layer by layer.
#include "point_network_kernels.h"

#include "simd.h"
#include "small_matrix.h"

namespace mien::MIEN_ISA {
namespace {

constexpr float kOctaves = 144.26950409f;  // 100 / ln 2
constexpr float kStep = 0.0069314718f;     // ln 2 / 100
constexpr float kLeast = -64.0f;           // 2^x below this is nothing beside 1, and still in the range of exp2_fast

// ln(1 + exp(100 x)) / 100
MIEN_INLINE F softplus(F x) {
  const F down = maximum(minimum(x, -x) * kOctaves, set1(kLeast));
  return maximum(x, F{}) + log2_precise(1.0f + exp2_fast(down)) * kStep;
}
// Its derivative, from its value: 1 - exp(-100 value).
MIEN_INLINE F softplus_slope(F value) {
  return maximum(1.0f - exp2_fast(maximum(value * -kOctaves, set1(kLeast))), F{});
}

MIEN_INLINE void activate(PointActivation activation, float* values, int64_t count) {
  if (activation == PointActivation::softplus) {
    for (int64_t i = 0; i < count; i += W) store(values + i, softplus(load(values + i)));
  } else if (activation == PointActivation::relu) {
    for (int64_t i = 0; i < count; i += W) store(values + i, maximum(load(values + i), F{}));
  }
}
MIEN_INLINE void through_activation(PointActivation activation, const float* values, float* gradients, int64_t count) {
  if (activation == PointActivation::softplus) {
    for (int64_t i = 0; i < count; i += W) {
      store(gradients + i, load(gradients + i) * softplus_slope(load(values + i)));
    }
  } else if (activation == PointActivation::relu) {
    for (int64_t i = 0; i < count; i += W) {
      store(gradients + i, keep(less(F{}, load(values + i)), load(gradients + i)));
    }
  }
}

// The rows of a block: those of the inputs, then those of each layer.
struct Rows {
  float* values;
  int64_t stride;
  int width;
};

float* lay_out(const PaddedPoints& network, float* memory, Rows* rows) {
  rows[0] = {memory, network.in_stride, network.own->inputs};
  memory += kPointBlock * network.in_stride;
  for (int l = 0; l < network.own->layers; ++l) {
    const PaddedLayer& layer = network.layers[l];
    rows[l + 1] = {memory, layer.out_stride, layer.outputs};
    memory += kPointBlock * layer.out_stride;
  }
  return memory;
}

MIEN_INLINE void fill_inputs(const PaddedPoints& network, int64_t index, float* row) {
  const int inputs = network.own->inputs;
  copy(row, network.own->values + index * inputs, inputs);
  for (int64_t c = inputs; c < network.in_stride; ++c) row[c] = 0;
}

void forward(const PaddedPoints& network, float* kept, float* outputs, float* scratch, int64_t first, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;
  const int layers = network.own->layers;
  Rows rows[kMostPointLayers + 1];
  lay_out(network, scratch, rows);
  for (int64_t begin = first; begin < end; begin += kPointBlock) {
    const int64_t count = end - begin < kPointBlock ? end - begin : kPointBlock;
    for (int64_t i = 0; i < count; ++i) fill_inputs(network, begin + i, rows[0].values + i * rows[0].stride);
    for (int l = 0; l < layers; ++l) {
      const PaddedLayer& layer = network.layers[l];
      if (l + 1 < layers) rows[l + 1].values = kept + layer.kept + begin * layer.out_stride;
      const Rows &from = rows[l], &to = rows[l + 1];
      multiply({from.values, from.stride, 1}, count, layer.first, to.stride, from.width, layer.bias, 0, to.values);
      if (layer.extra >= 0) {
        const Rows& extra = rows[layer.extra];
        multiply({extra.values, extra.stride, 1}, count, layer.extra_first, to.stride, extra.width, to.values,
                 to.stride, to.values);
      }
      activate(layer.activation, to.values, count * to.stride);
    }
    const Rows& last = rows[layers];
    for (int64_t i = 0; i < count; ++i) {
      copy(outputs + (begin + i) * last.width, last.values + i * last.stride, last.width);
    }
  }
}

constexpr int kTileVectors = 3;                // vectors of points in a tile; a block has a whole number of tiles
constexpr int kTileOutputs = W == 16 ? 8 : 4;  // so that a tile fits into the registers
static_assert(kPointBlock % (kTileVectors * W) == 0);

// T rows of `out`, for a tile's points: biases, or if there are none the rows themselves, plus `values` [end,
// kPointBlock] weighted by rows of weights.
template <int T>
MIEN_INLINE void column_tile(const float* weights, int64_t row, int64_t begin, int64_t end, const float* biases,
                             const float* values, float* out) {
  F sums[T][kTileVectors];
  for (int t = 0; t < T; ++t)
    for (int v = 0; v < kTileVectors; ++v) sums[t][v] = biases ? set1(biases[t]) : load(out + t * kPointBlock + v * W);
  for (int64_t k = begin; k < end; ++k) {
    F own[kTileVectors];
    for (int v = 0; v < kTileVectors; ++v) own[v] = load(values + k * kPointBlock + v * W);
    for (int t = 0; t < T; ++t) {
      const F weight = set1(weights[t * row + k]);
      for (int v = 0; v < kTileVectors; ++v) sums[t][v] = sums[t][v] + own[v] * weight;
    }
  }
  for (int t = 0; t < T; ++t)
    for (int v = 0; v < kTileVectors; ++v) store(out + t * kPointBlock + v * W, sums[t][v]);
}

template <int T>
void add_weighted(const float* weights, int64_t row, int begin, int end, const float* biases, const float* values,
                  float* out) {
  for (int p = 0; p < kPointBlock; p += kTileVectors * W) {
    column_tile<T>(weights, row, begin, end, biases, values + p, out + p);
  }
}

MIEN_INLINE bool same(const WeightSpan& a, const WeightSpan& b) {
  return a.begin == b.begin && a.end == b.end && a.extra_begin == b.extra_begin && a.extra_end == b.extra_end;
}

template <int T>
void add_outputs(const PointLayer& layer, const WeightSpan& span, int reads, int64_t row, int output,
                 const float* values, const float* extra, float* out) {
  const float* weights = layer.weight + output * row;
  float* const to = out + output * kPointBlock;
  add_weighted<T>(weights, row, span.begin, span.end, layer.bias + output, values, to);
  if (extra) add_weighted<T>(weights + reads, row, span.extra_begin, span.extra_end, nullptr, extra, to);
}

// One layer of a block, whose points are side by side: out [outputs, kPointBlock].
void layer_of_columns(const PointLayer& layer, const WeightSpan* spans, int reads, int extra_reads, const float* values,
                      const float* extra, float* out) {
  const int64_t row = reads + extra_reads;
  for (int o = 0; o < layer.outputs;) {
    int alike = 1;
    while (alike < kTileOutputs && o + alike < layer.outputs && same(spans[o], spans[o + alike])) ++alike;
    if (alike >= kTileOutputs) {
      add_outputs<kTileOutputs>(layer, spans[o], reads, row, o, values, extra, out), o += kTileOutputs;
    } else if (alike >= 4) {
      add_outputs<4>(layer, spans[o], reads, row, o, values, extra, out), o += 4;
    } else if (alike >= 2) {
      add_outputs<2>(layer, spans[o], reads, row, o, values, extra, out), o += 2;
    } else {
      add_outputs<1>(layer, spans[o], reads, row, o, values, extra, out), o += 1;
    }
  }
  activate(layer.activation, out, static_cast<int64_t>(layer.outputs) * kPointBlock);
}

// As `forward`, with the points of a block side by side in vectors: outputs fill no vector up with zeros, and zeros at
// the ends of a row of weights cost nothing. All sums have the order of `forward`, and so the same bits.
void outputs_of(const PaddedPoints& network, float* outputs, float* scratch, int64_t first, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;
  const int layers = network.own->layers, inputs = network.own->inputs;
  float* values[kMostPointLayers + 1];
  // At a whole vector of the widest kind: half of the scratch is not used.
  values[0] = (float*)(((uintptr_t)scratch + 63) & ~(uintptr_t)63);
  for (int l = 0; l < layers; ++l)
    values[l + 1] = values[l] + kPointBlock * (l ? network.layers[l - 1].outputs : inputs);
  const int last = network.layers[layers - 1].outputs;
  for (int64_t begin = first; begin < end; begin += kPointBlock) {
    const int64_t count = end - begin < kPointBlock ? end - begin : kPointBlock;
    for (int c = 0; c < inputs; ++c) {
      float* const column = values[0] + c * kPointBlock;
      for (int64_t i = 0; i < kPointBlock; ++i) {
        column[i] = i < count ? network.own->values[(begin + i) * inputs + c] : 0.0f;
      }
    }
    for (int l = 0; l < layers; ++l) {
      const PointLayer& layer = network.own->items[l];
      const bool more = layer.extra >= 0;
      const int reads = l ? network.layers[l - 1].outputs : inputs;
      const int extra = !more ? 0 : layer.extra ? network.layers[layer.extra - 1].outputs : inputs;
      layer_of_columns(layer, network.layers[l].spans, reads, extra, values[l], more ? values[layer.extra] : nullptr,
                       values[l + 1]);
    }
    for (int64_t i = 0; i < count; ++i) {
      for (int o = 0; o < last; ++o) outputs[(begin + i) * last + o] = values[layers][o * kPointBlock + i];
    }
  }
}

// A block of points that have gradients, with their rows in scratch.
struct Block {
  int64_t index[kPointBlock];
  int64_t count = 0;
  Rows rows[kMostPointLayers + 1], by[kMostPointLayers + 1];
  const float* zeros;
};

void gather(const PaddedPoints& network, const float* kept, const float* by_outputs, int64_t index, Block& block) {
  const int layers = network.own->layers;
  const int64_t i = block.count++;
  block.index[i] = index;
  fill_inputs(network, index, block.rows[0].values + i * block.rows[0].stride);
  for (int l = 0; l + 1 < layers; ++l) {
    const Rows& rows = block.rows[l + 1];
    copy(rows.values + i * rows.stride, kept + network.layers[l].kept + index * rows.stride, rows.stride);
  }
  const Rows& by = block.by[layers];
  float* const row = by.values + i * by.stride;
  copy(row, by_outputs + index * by.width, by.width);
  for (int64_t c = by.width; c < by.stride; ++c) row[c] = 0;
}

// Adds to the sums of the weights by which a layer reads `from`, and, unless its gradient is not wanted, to that of
// `from`.
MIEN_INLINE void read_back(const Block& block, const Rows& by, const Rows& from, const float* weights, float* sums,
                           const Rows* by_from, bool& touched) {
  multiply({by.values, 1, by.stride}, by.width, from.values, from.stride, block.count, sums, from.stride, sums);
  if (!by_from) return;
  const float* const start = touched ? by_from->values : block.zeros;
  multiply({by.values, by.stride, 1}, block.count, weights, from.stride, by.width, start, touched ? from.stride : 0,
           by_from->values);
  touched = true;
}

void backward_block(const PaddedPoints& network, float* by_inputs, float* sums, Block& block) {
  bool touched[kMostPointLayers + 1] = {};
  for (int l = network.own->layers - 1; l >= 0; --l) {
    const PaddedLayer& layer = network.layers[l];
    const Rows& by = block.by[l + 1];
    through_activation(layer.activation, block.rows[l + 1].values, by.values, block.count * by.stride);
    add_rows(by.values, block.count, by.stride, sums + layer.bias_sums);
    const int reads[2] = {layer.extra, l};
    for (const int from : reads) {
      if (from < 0) continue;
      const bool own = from == l, wanted = from > 0 || by_inputs;
      read_back(block, by, block.rows[from], own ? layer.back : layer.extra_back,
                sums + (own ? layer.sums : layer.extra_sums), wanted ? &block.by[from] : nullptr, touched[from]);
    }
  }
  if (by_inputs) {
    const Rows& by = block.by[0];
    for (int64_t i = 0; i < block.count; ++i) {
      copy(by_inputs + block.index[i] * by.width, by.values + i * by.stride, by.width);
    }
  }
  block.count = 0;
}

void backward(const PaddedPoints& network, const float* kept, const float* by_outputs, float* by_inputs, float* sums,
              float* scratch, int64_t first, int64_t end) {
  [[maybe_unused]] const NoDenormals guard;
  const int inputs = network.own->inputs, outputs = network.layers[network.own->layers - 1].outputs;
  Block block;
  float* const zeros = lay_out(network, lay_out(network, scratch, block.rows), block.by);
  memset(zeros, 0, sizeof(float) * (network.scratch - (zeros - scratch)));
  block.zeros = zeros;
  for (int64_t index = first; index < end; ++index) {
    if (all_zero(by_outputs + index * outputs, outputs)) {
      if (by_inputs) memset(by_inputs + index * inputs, 0, sizeof(float) * inputs);
      continue;
    }
    gather(network, kept, by_outputs, index, block);
    if (block.count == kPointBlock) backward_block(network, by_inputs, sums, block);
  }
  if (block.count > 0) backward_block(network, by_inputs, sums, block);
}

}  // namespace

extern const PointKernels point_kernels;
const PointKernels point_kernels = {forward, outputs_of, backward};

}  // namespace mien::MIEN_ISA
