#include "surface_limits.h"

#include <algorithm>
#include <cmath>

#include "pool.h"

namespace mien {
namespace {

constexpr int64_t kGaussians = 4096;  // in one piece of the pool's work
constexpr int kLimits = 5, kPulls = 4;

void normalize(float* quat) {
  float squared = 0;
  for (int i = 0; i < 4; ++i) squared += quat[i] * quat[i];
  const float length = std::max(std::sqrt(squared), 1e-12f);
  for (int i = 0; i < 4; ++i) quat[i] /= length;
}

// The sine of half the angle between the thin axis and the normal is the length of the second and the fourth number.
void make_level(float most, float* quat) {
  const float squared = quat[1] * quat[1] + quat[3] * quat[3];
  if (!(squared > most * most)) return;
  const float tilted = std::sqrt(squared), level = std::sqrt(quat[0] * quat[0] + quat[2] * quat[2]);
  const float aside = most / std::max(tilted, 1e-12f);
  const float upright = std::sqrt(std::max(1 - most * most, 0.0f)) / std::max(level, 1e-6f);
  quat[0] *= upright;
  quat[2] *= upright;
  quat[1] *= aside;
  quat[3] *= aside;
}

void keep(const SurfaceLimits& task, int64_t index) {
  const int64_t triangle = task.triangle[index];
  const float* const limits = task.limits + kLimits * triangle;
  float& place = task.means[3 * index + 1];
  place = std::min(std::max(place, limits[0]), limits[1]);
  float* const scales = task.log_scales + 3 * index;
  scales[1] = std::min(scales[1], limits[2]);
  const float across = std::min(scales[0], limits[3]), along = std::min(scales[2], limits[3]);
  // The shorter one grows. No picture holds it once it is thinner than a pixel, and it would draw the other with it.
  scales[0] = std::max(across, along - task.ratio);
  scales[2] = std::max(along, across - task.ratio);
  normalize(task.quats + 4 * index);
  make_level(limits[4], task.quats + 4 * index);
  if (!task.pulls) return;
  const float* const pull = task.pulls + kPulls * triangle;
  for (int c = 0; c < 3; ++c) {
    float& color = task.colors[3 * index + c];
    color += pull[3] * (pull[c] - color);
  }
}

}  // namespace

void keep_on_surface(const SurfaceLimits& task) {
  parallel_for((task.count + kGaussians - 1) / kGaussians, [&](int64_t piece) {
    const int64_t end = std::min((piece + 1) * kGaussians, task.count);
    for (int64_t index = piece * kGaussians; index < end; ++index) keep(task, index);
  });
}

void clear_rows(const uint8_t* chosen, int64_t count, int64_t width, float* values) {
  parallel_for((count + kGaussians - 1) / kGaussians, [&](int64_t piece) {
    const int64_t end = std::min((piece + 1) * kGaussians, count);
    for (int64_t index = piece * kGaussians; index < end; ++index) {
      if (chosen[index]) std::fill_n(values + index * width, width, 0.0f);
    }
  });
}

}  // namespace mien
