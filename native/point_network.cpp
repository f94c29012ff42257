#include "point_network.h"

#include <algorithm>
#include <vector>

#include "isa.h"
#include "point_network_kernels.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(PointKernels, point_kernels)

namespace {

constexpr int kLanes = 16;  // of the widest vector

int64_t padded(int64_t width) { return (width + kLanes - 1) / kLanes * kLanes; }

// Widths of the values that layers read: the inputs, then each layer's outputs.
int width_of(const PointNetwork& network, int values) {
  return values == 0 ? network.inputs : network.items[values - 1].outputs;
}

// Points in one piece of the pool's work. It depends on their number only, and so does the order of all sums: at most
// 16 pieces, since each has its own sums.
int64_t piece_of(int64_t count) {
  const int64_t blocks = (count + kPointBlock - 1) / kPointBlock;
  return std::max<int64_t>(8, (blocks + 15) / 16) * kPointBlock;
}

enum class Pass { forward, backward, outputs };

// All padded weights of a network. Sizes are known before anything is written, so that no address changes.
class Packed {
 public:
  PaddedPoints network{};

  Packed(const PointNetwork& own, Pass pass) {
    network.own = &own, network.in_stride = padded(own.inputs);
    int64_t size = 0, hidden = 0;
    for (int l = 0; l < own.layers; ++l) {
      const PointLayer& layer = own.items[l];
      PaddedLayer& out = network.layers[l];
      out.outputs = layer.outputs, out.extra = layer.extra, out.activation = layer.activation;
      out.out_stride = padded(layer.outputs);
      out.kept = own.count * hidden;
      hidden += out.out_stride;
      const int64_t reads = width_of(own, l), extra = layer.extra < 0 ? 0 : width_of(own, layer.extra);
      out.sums = sums_, sums_ += layer.outputs * padded(reads);
      out.extra_sums = sums_, sums_ += layer.outputs * padded(extra);
      out.bias_sums = sums_, sums_ += out.out_stride;
      if (pass == Pass::forward) size += (reads + extra + 1) * out.out_stride;
      if (pass == Pass::backward) size += layer.outputs * (padded(reads) + padded(extra));
    }
    // Two rows for each value: the value itself and its gradient; and zeros.
    network.scratch = kPointBlock * 2 * (network.in_stride + hidden) + widest();
    thread_local std::vector<float> buffer;
    buffer.assign(size, 0.0f);
    next_ = buffer.data();
    if (pass == Pass::outputs) find_spans();
    for (int l = 0; l < own.layers && pass == Pass::forward; ++l) pack_columns(l);
    for (int l = 0; l < own.layers && pass == Pass::backward; ++l) pack_rows(l);
  }
  int64_t sums() const { return sums_; }

 private:
  float* next_ = nullptr;
  int64_t sums_ = 0;

  void find_spans() {
    thread_local std::vector<WeightSpan> spans;
    spans.clear();
    for (int l = 0; l < network.own->layers; ++l) {
      const PointLayer& layer = network.own->items[l];
      const int reads = width_of(*network.own, l), extra = layer.extra < 0 ? 0 : width_of(*network.own, layer.extra);
      for (int o = 0; o < layer.outputs; ++o) {
        const float* row = layer.weight + static_cast<int64_t>(o) * (reads + extra);
        WeightSpan span;
        not_zero(row, reads, span.begin, span.end);
        not_zero(row + reads, extra, span.extra_begin, span.extra_end);
        spans.push_back(span);
      }
    }
    const WeightSpan* next = spans.data();
    for (int l = 0; l < network.own->layers; ++l) {
      network.layers[l].spans = next;
      next += network.layers[l].outputs;
    }
  }
  static void not_zero(const float* values, int count, int& begin, int& end) {
    begin = 0, end = count;
    while (begin < end && values[begin] == 0) ++begin;
    while (end > begin && values[end - 1] == 0) --end;
  }

  int64_t widest() const {
    int64_t most = network.in_stride;
    for (int l = 0; l < network.own->layers; ++l) most = std::max(most, network.layers[l].out_stride);
    return most;
  }

  const float* transposed(const float* from, int64_t rows, int64_t width, int64_t row, int64_t stride) {
    float* const to = next_;
    for (int64_t r = 0; r < rows; ++r) {
      for (int64_t c = 0; c < width; ++c) to[c * stride + r] = from[r * row + c];
    }
    next_ += width * stride;
    return to;
  }
  const float* rows_of(const float* from, int64_t rows, int64_t width, int64_t row, int64_t stride) {
    float* const to = next_;
    for (int64_t r = 0; r < rows; ++r) std::copy_n(from + r * row, width, to + r * stride);
    next_ += rows * stride;
    return to;
  }

  void pack_columns(int l) {
    const PointLayer& layer = network.own->items[l];
    PaddedLayer& out = network.layers[l];
    const int64_t reads = width_of(*network.own, l);
    const int64_t extra = layer.extra < 0 ? 0 : width_of(*network.own, layer.extra), row = reads + extra;
    out.first = transposed(layer.weight, layer.outputs, reads, row, out.out_stride);
    out.extra_first = extra ? transposed(layer.weight + reads, layer.outputs, extra, row, out.out_stride) : nullptr;
    out.bias = rows_of(layer.bias, 1, layer.outputs, 0, out.out_stride);
  }
  void pack_rows(int l) {
    const PointLayer& layer = network.own->items[l];
    PaddedLayer& out = network.layers[l];
    const int64_t reads = width_of(*network.own, l);
    const int64_t extra = layer.extra < 0 ? 0 : width_of(*network.own, layer.extra), row = reads + extra;
    out.back = rows_of(layer.weight, layer.outputs, reads, row, padded(reads));
    out.extra_back = extra ? rows_of(layer.weight + reads, layer.outputs, extra, row, padded(extra)) : nullptr;
  }
};

float* scratch_of(const PaddedPoints& network) {
  thread_local std::vector<float> scratch;
  scratch.resize(network.scratch);
  return scratch.data();
}

void write_sums(const PaddedPoints& network, const float* sums, const PointLayerGradients* gradients) {
  for (int l = 0; l < network.own->layers; ++l) {
    const PaddedLayer& layer = network.layers[l];
    const int64_t reads = width_of(*network.own, l);
    const int64_t extra = layer.extra < 0 ? 0 : width_of(*network.own, layer.extra), row = reads + extra;
    for (int64_t r = 0; r < layer.outputs; ++r) {
      std::copy_n(sums + layer.sums + r * padded(reads), reads, gradients[l].weight + r * row);
      std::copy_n(sums + layer.extra_sums + r * padded(extra), extra, gradients[l].weight + r * row + reads);
    }
    std::copy_n(sums + layer.bias_sums, layer.outputs, gradients[l].bias);
  }
}

}  // namespace

int64_t point_kept_floats(const PointNetwork& network) {
  int64_t floats = 0;
  for (int l = 0; l + 1 < network.layers; ++l) floats += padded(network.items[l].outputs);
  return floats;
}

void point_network(const PointNetwork& network, float* kept, float* outputs) {
  const Packed packed(network, kept ? Pass::forward : Pass::outputs);
  const PointKernels& kernels = point_kernels();
  const int64_t piece = piece_of(network.count);
  parallel_for((network.count + piece - 1) / piece, [&](int64_t index) {
    float* const scratch = scratch_of(packed.network);
    const int64_t end = std::min((index + 1) * piece, network.count);
    if (kept) {
      kernels.forward(packed.network, kept, outputs, scratch, index * piece, end);
    } else {
      kernels.outputs(packed.network, outputs, scratch, index * piece, end);
    }
  });
}

void point_network_backward(const PointNetwork& network, float* kept, const PointGradients& gradients) {
  const Packed packed(network, Pass::backward);
  const PointKernels& kernels = point_kernels();
  const int64_t piece = piece_of(network.count), pieces = (network.count + piece - 1) / piece, size = packed.sums();
  thread_local std::vector<float> buffer;
  buffer.resize((pieces + 1) * size);
  float* const sums = buffer.data();
  parallel_for(pieces, [&](int64_t index) {
    float* const own = sums + (index + 1) * size;
    std::fill_n(own, size, 0.0f);
    kernels.backward(packed.network, kept, gradients.outputs, gradients.inputs, own, scratch_of(packed.network),
                     index * piece, std::min((index + 1) * piece, network.count));
  });
  std::fill_n(sums, size, 0.0f);
  for (int64_t index = 1; index <= pieces; ++index) {  // in the order of the points
    const float* own = sums + index * size;
    for (int64_t i = 0; i < size; ++i) sums[i] += own[i];
  }
  write_sums(packed.network, sums, gradients.layers);
}

}  // namespace mien
