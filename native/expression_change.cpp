#include "expression_change.h"

#include <algorithm>

#include "face.h"
#include "pool.h"

namespace mien {

namespace {

constexpr int64_t kGrain = 4096;  // Gaussians in one piece of the pool's work
constexpr float kMargin = 0.1f;   // the same numbers as in Python
constexpr float kLeastSeen = 1e-6f;

float dot(const float* one, const float* other, int64_t count) {
  float sum = 0;
  for (int64_t k = 0; k < count; ++k) sum += one[k] * other[k];
  return sum;
}

// What the activations of a block are multiplied by.
float shortening(const ActivationArrays& arrays, const float* values, int64_t begin) {
  if (arrays.seen.empty()) return 1;
  float furthest = kLeastSeen;
  for (size_t s = 0; s < arrays.seen.size(); s += arrays.rank)
    furthest = std::max(furthest, dot(values, arrays.seen.data() + s + begin, arrays.block));
  const float ratio = dot(values, values, arrays.block) / furthest, over = ratio - 1;
  return over > 0 ? (1 + kMargin * over / (kMargin + over)) / ratio : 1;
}

template <class Each>
void for_all(const ExpressionBases& bases, const Each& each) {
  parallel_for((bases.count + kGrain - 1) / kGrain, [&](int64_t piece) {
    for (int64_t i = piece * kGrain; i < std::min((piece + 1) * kGrain, bases.count); ++i) {
      const float* activations = bases.activations + (bases.rows ? bases.rows[i] * bases.width : 0);
      for (int64_t v = i * bases.values; v < (i + 1) * bases.values; ++v) each(activations, v);
    }
  });
}

// No operation here may round in two ways, so these use neither `exp` nor kernels.
void activations_along(const ActivationArrays& arrays, const float* inputs, float* out) {
  for (int64_t k = 0; k < arrays.rank; ++k) {
    float sum = 0;
    for (size_t i = 0; i < arrays.rest.size(); ++i) {
      sum += (inputs[i] - arrays.rest[i]) * arrays.directions[i * arrays.rank + k];
    }
    out[k] = sum;
  }
  for (int64_t begin = 0; begin < arrays.rank; begin += arrays.block) {
    const float factor = shortening(arrays, out + begin, begin);
    for (int64_t k = begin; k < begin + arrays.block; ++k) out[k] *= factor;
  }
}

// How the head moved: the sines of its turns about its own axes at rest, and its shift along them, in metres.
void head_motion(const float* rest, const float* pose, float* out) {
  float from[16], to[16], turn[9];
  head_pose(rest, rest + 3, from);
  head_pose(pose, pose + 3, to);
  for (int row = 0; row < 3; ++row) {
    out[3 + row] = 0;
    for (int k = 0; k < 3; ++k) out[3 + row] += from[4 * k + row] * (pose[3 + k] - rest[3 + k]);
    for (int column = 0; column < 3; ++column) {
      float& sum = turn[3 * row + column];
      sum = 0;
      for (int k = 0; k < 3; ++k) sum += from[4 * k + row] * to[4 * k + column];
    }
  }
  out[0] = (turn[7] - turn[5]) / 2, out[1] = (turn[2] - turn[6]) / 2, out[2] = (turn[3] - turn[1]) / 2;
}

// out [rows, width] = shares [rows, regions] table [regions, width], in the order of the regions.
void blend_regions(const FaceActivations& face, const float* table, float* out) {
  const int64_t regions = face.regions(), width = face.width();
  for (int64_t row = 0; row < face.rows(); ++row) {
    float* const to = out + row * width;
    std::fill_n(to, width, 0.0f);
    for (int64_t region = 0; region < regions; ++region) {
      const float share = face.shares[row * regions + region];
      if (share == 0) continue;
      for (int64_t k = 0; k < width; ++k) to[k] += share * table[region * width + k];
    }
  }
}

}  // namespace

void activation_table(const FaceActivations& face, const float* inputs, const float* pose, float* out) {
  const int64_t width = face.width(), of_head = width - face.own.block;
  std::vector<float> own(face.own.rank), head(of_head), table(face.regions() * width);
  activations_along(face.own, inputs, own.data());
  if (of_head > 0) {
    float motion[6];
    head_motion(face.head_rest.data(), pose, motion);
    activations_along(face.head, motion, head.data());
  }
  for (int64_t region = 0; region < face.regions(); ++region) {
    float* to = table.data() + region * width;
    for (int64_t k = 0; k < std::max(face.own.block, of_head); ++k) {
      if (k < face.own.block) *to++ = own[region * face.own.block + k];
      if (k < of_head) *to++ = head[k];
    }
  }
  if (face.shares.empty())
    std::copy(table.begin(), table.end(), out);
  else
    blend_regions(face, table.data(), out);
}

void expression_change(const ExpressionBases& bases, const float* basis, float* out) {
  for_all(bases,
          [&](const float* activations, int64_t v) { out[v] = dot(basis + v * bases.rank, activations, bases.rank); });
}

}  // namespace mien
