// Limits that keep Gaussians on the surface of a mesh (src/mien/avatar/gaussian_avatars/surface_limits.py has the same
// in plain PyTorch), and the rows that no gradient may reach.
#pragma once

#include <cstdint>

namespace mien {

// Lengths are in units of the triangle's size, in its frame, whose second axis is the normal.
struct SurfaceLimits {
  int64_t count;
  const int64_t* triangle;  // [n]
  const float* limits;      // [f, 5]: lowest and highest place, largest thickness and width (both logarithms), and the
                            // largest sine of half the tilt
  float ratio;              // logarithm of the largest ratio of both widths
  float *means, *quats, *log_scales;
  const float* pulls;  // [f, 4]: a colour, and the share of the way to it; null for none
  float* colors;       // [n, 3]
};
// Brings Gaussians that are beyond the limits back to them, and pulls colours. Runs on the pool.
void keep_on_surface(const SurfaceLimits& task);

// Sets rows of values [n, width] to 0 where `chosen` [n] is not 0. Runs on the pool.
void clear_rows(const uint8_t* chosen, int64_t count, int64_t width, float* values);

}  // namespace mien
