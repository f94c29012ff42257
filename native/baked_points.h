// What mien.runtime does with the points of a baked avatar besides skinning and networks
// (src/mien/runtime/posing.py has the same in numpy).
#pragma once

#include <cstdint>

namespace mien {

// Adds to `posed` [count, 3] what a bone contributes that is no joint of the face: transform [3, 4] of `shaped`
// [count, 3], times its weights [count]. Runs on the pool.
void add_bone(const float* shaped, const float* weights, const float* transform, int64_t count, float* posed);

constexpr int kPointAttributes = 11;  // log scales, quaternion, opacity logit, colour

struct RawPoints {
  int64_t count;
  const float* changes;  // [count, kPointAttributes]
  const float *log_scales, *quats, *opacity_logits, *colours;
};
struct ActivatedPoints {
  float *scales, *quats, *opacities, *sh;
};
// Sums of raw attributes and their changes, activated: scales by gain * sigmoid + offset, colours by a sigmoid. Runs on
// the pool.
void activate_points(const RawPoints& raw, float gain, float offset, const ActivatedPoints& out);

}  // namespace mien
