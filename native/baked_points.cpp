#include "baked_points.h"

#include <algorithm>

#include "activation.h"
#include "pool.h"

namespace mien {
namespace {

constexpr int64_t kGrain = 1024;  // points in one piece of the pool's work
constexpr float kConstantHarmonic = 0.28209479177387814f;

template <typename Body>
void for_pieces(int64_t count, Body&& body) {
  parallel_for((count + kGrain - 1) / kGrain,
               [&](int64_t piece) { body(piece * kGrain, std::min((piece + 1) * kGrain, count)); });
}

}  // namespace

void add_bone(const float* shaped, const float* weights, const float* transform, int64_t count, float* posed) {
  for_pieces(count, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const float x = shaped[3 * i], y = shaped[3 * i + 1], z = shaped[3 * i + 2];
      for (int r = 0; r < 3; ++r) {
        const float* row = transform + 4 * r;
        posed[3 * i + r] += weights[i] * (row[0] * x + row[1] * y + row[2] * z + row[3]);
      }
    }
  });
}

void activate_points(const RawPoints& raw, float gain, float offset, const ActivatedPoints& out) {
  for_pieces(raw.count, [&](int64_t begin, int64_t end) {
    float sums[kGrain * 7];  // scales, opacity and colour of each point
    float* next = sums;
    for (int64_t i = begin; i < end; ++i) {
      const float* change = raw.changes + kPointAttributes * i;
      for (int c = 0; c < 3; ++c) *next++ = raw.log_scales[3 * i + c] + change[c];
      for (int c = 0; c < 4; ++c) out.quats[4 * i + c] = raw.quats[4 * i + c] + change[3 + c];
      *next++ = raw.opacity_logits[i] + change[7];
      for (int c = 0; c < 3; ++c) *next++ = raw.colours[3 * i + c] + change[8 + c];
    }
    sigmoid(sums, next - sums, sums);
    const float* own = sums;
    for (int64_t i = begin; i < end; ++i, own += 7) {
      for (int c = 0; c < 3; ++c) out.scales[3 * i + c] = gain * own[c] + offset;
      out.opacities[i] = own[3];
      for (int c = 0; c < 3; ++c) out.sh[3 * i + c] = (own[4 + c] - 0.5f) / kConstantHarmonic;
    }
  });
}

}  // namespace mien
