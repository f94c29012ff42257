// The photometric loss of Gaussian splatting: L1 and SSIM, value and gradient in one pass over the rows.
#pragma once

#include <cstdint>

namespace mien {

struct Box {
  int left, top, right, bottom;  // pixels; right and bottom are outside
};

struct PhotometricTask {
  const float* image;           // [h,w,3]
  const float* target;          // [h,w,3], or null where target_bytes is given
  const uint8_t* target_bytes;  // [h,w,3], 255 is 1.0
  int width;                    // at least 6
  int height;
  // Not empty, inside the picture. Pixels outside count as equal, but the windows of pixels inside see them.
  Box box;
  float l1_weight;
  float ssim_weight;
  float* gradient;  // [h,w,3] d loss / d image, or null; 0 where no window reaches into the box
};

// l1_weight * mean |image - target| + ssim_weight * (1 - mean SSIM), means over all pixels and channels of the picture.
// SSIM: 11x11 Gaussian window, sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2 (Wang et al. 2004, as used
// by Kerbl et al. 2023). Runs on the pool; the result does not depend on the number of threads.
double photometric_loss(const PhotometricTask& task);

}  // namespace mien
