#include "feature_network.h"

#include <algorithm>
#include <vector>

#include "feature_network_kernels.h"
#include "isa.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(FeatureKernels, feature_kernels)

namespace {

constexpr int64_t kPiece = 16 * kFeatureBlock;  // Gaussians in one piece of the pool's work
constexpr int kLanes = 16;                      // of the widest vector

int64_t padded(int64_t width) { return (width + kLanes - 1) / kLanes * kLanes; }

// Rows [rows, width] to rows of `stride`.
const float* pad_rows(const float* from, int64_t rows, int64_t width, int64_t from_stride, int64_t stride,
                      std::vector<float>& out) {
  out.assign(rows * stride, 0.0f);
  for (int64_t r = 0; r < rows; ++r) std::copy_n(from + r * from_stride, width, out.data() + r * stride);
  return out.data();
}

const float* transpose(const float* from, int64_t rows, int64_t width, int64_t stride, std::vector<float>& out) {
  out.assign(width * stride, 0.0f);
  for (int64_t r = 0; r < rows; ++r) {
    for (int64_t c = 0; c < width; ++c) out[c * stride + r] = from[r * width + c];
  }
  return out.data();
}

PaddedNetwork pad(const FeatureNetwork& own, bool backward, bool by_owns = false) {
  thread_local std::vector<float> buffers[6];
  const int64_t in = own.features + own.own;
  PaddedNetwork network{};
  network.own = &own;
  const int64_t back = by_owns ? in : own.features;  // numbers of a row whose gradients are made
  network.in_stride = padded(in), network.feature_stride = padded(back);
  network.hidden_stride = padded(own.hidden), network.out_stride = padded(own.width);
  if (backward) {
    network.second_back = pad_rows(own.weight2, own.width, own.hidden, own.hidden, network.hidden_stride, buffers[4]);
    network.first_back = pad_rows(own.weight1, own.hidden, back, in, network.feature_stride, buffers[5]);
  } else {
    network.first = transpose(own.weight1, own.hidden, in, network.hidden_stride, buffers[0]);
    network.first_bias = pad_rows(own.bias1, 1, own.hidden, own.hidden, network.hidden_stride, buffers[1]);
    network.second = transpose(own.weight2, own.width, own.hidden, network.out_stride, buffers[2]);
    network.second_bias = pad_rows(own.bias2, 1, own.width, own.width, network.out_stride, buffers[3]);
  }
  return network;
}

// The thread's own memory for a piece.
float* scratch_of(const PaddedNetwork& network) {
  thread_local std::vector<float> scratch;
  const int64_t row = network.in_stride + 2 * network.hidden_stride + network.out_stride + network.feature_stride;
  scratch.resize(kFeatureBlock * row + network.hidden_stride + network.feature_stride);
  return scratch.data();
}

// The inputs that are not 0 for all Gaussians.
std::vector<int64_t> used_inputs(const FeatureInputs& inputs) {
  std::vector<int64_t> used;
  for (int64_t k = 0; k < inputs.count; ++k)
    if (inputs.rows || inputs.values[k] != 0) used.push_back(k);
  return used;
}

struct SumsLayout {
  int64_t first, first_bias, second, second_bias, inputs, size;  // offsets, and the floats of a piece
};

SumsLayout layout_of(const PaddedNetwork& network, int64_t inputs) {
  const FeatureNetwork& own = *network.own;
  SumsLayout at{};
  at.first_bias = own.hidden * network.in_stride;
  at.second = at.first_bias + network.hidden_stride;
  at.second_bias = at.second + own.width * network.hidden_stride;
  at.inputs = at.second_bias + network.out_stride;
  at.size = at.inputs + kLanes * inputs;
  return at;
}

void write_rows(const float* from, int64_t rows, int64_t width, int64_t stride, float* to) {
  for (int64_t r = 0; r < rows; ++r) std::copy_n(from + r * stride, width, to + r * width);
}

void write_sums(const PaddedNetwork& network, const SumsLayout& at, int64_t inputs, const float* sums,
                const FeatureGradients& gradients) {
  const FeatureNetwork& own = *network.own;
  write_rows(sums, own.hidden, own.features + own.own, network.in_stride, gradients.weight1);
  write_rows(sums + at.first_bias, 1, own.hidden, 0, gradients.bias1);
  write_rows(sums + at.second, own.width, own.hidden, network.hidden_stride, gradients.weight2);
  write_rows(sums + at.second_bias, 1, own.width, 0, gradients.bias2);
  if (!gradients.inputs) return;
  for (int64_t k = 0; k < inputs; ++k) {
    const float* lanes = sums + at.inputs + kLanes * k;
    gradients.inputs[k] = 0;
    for (int lane = 0; lane < kLanes; ++lane) gradients.inputs[k] += lanes[lane];
  }
}

}  // namespace

int64_t hidden_stride(int hidden) { return padded(hidden); }

void feature_network(const FeatureNetwork& network, const FeatureInputs& inputs, const FeatureKept& kept,
                     float* outputs, float* last) {
  const PaddedNetwork own = pad(network, false);
  const std::vector<int64_t> used = used_inputs(inputs);
  const FeatureKernels& kernels = feature_kernels();
  parallel_for((network.count + kPiece - 1) / kPiece, [&](int64_t piece) {
    kernels.forward(own, inputs, {used.data(), static_cast<int64_t>(used.size())}, kept, outputs, last, scratch_of(own),
                    piece * kPiece, std::min((piece + 1) * kPiece, network.count));
  });
}

void feature_network_backward(const FeatureNetwork& network, const FeatureInputs& inputs, const FeatureKept& kept,
                              const FeatureGradients& gradients) {
  const PaddedNetwork own = pad(network, true, gradients.owns != nullptr);
  const SumsLayout at = layout_of(own, inputs.count);
  const int64_t pieces = (network.count + kPiece - 1) / kPiece;
  thread_local std::vector<float> buffer;
  buffer.resize((pieces + 1) * at.size);
  float* const sums = buffer.data();
  const FeatureKernels& kernels = feature_kernels();
  parallel_for(pieces, [&](int64_t piece) {
    float* const part = sums + (piece + 1) * at.size;
    std::fill_n(part, at.size, 0.0f);
    const FeatureSums into{part, part + at.first_bias, part + at.second, part + at.second_bias, part + at.inputs};
    kernels.backward(own, inputs, kept, gradients, into, scratch_of(own), piece * kPiece,
                     std::min((piece + 1) * kPiece, network.count));
  });
  std::fill_n(sums, at.size, 0.0f);
  for (int64_t piece = 1; piece <= pieces; ++piece) {  // in the order of the Gaussians
    const float* part = sums + piece * at.size;
    for (int64_t i = 0; i < at.size; ++i) sums[i] += part[i];
  }
  write_sums(own, at, inputs.count, sums, gradients);
}

void factored_update(const FactoredUpdate& task) {
  const auto terms = static_cast<size_t>(task.terms_count);
  const FeatureKernels& kernels = feature_kernels();
  parallel_for((task.count + kPiece - 1) / kPiece, [&](int64_t piece) {
    thread_local std::vector<float> scratch;
    scratch.resize(terms * (terms + task.width));
    kernels.update(task, scratch.data(), scratch.data() + terms * terms, piece * kPiece,
                   std::min((piece + 1) * kPiece, task.count));
  });
}

}  // namespace mien
