// The arguments of the photometric kernel, which is compiled once per instruction set.
#pragma once

#include <cstdint>

namespace mien {

constexpr int kPhotometricRadius = 5;
// Pictures stay interleaved: a pixel's neighbour is 3 floats away, and every step works on plain rows of floats.
constexpr int kPhotometricChannels = 3;
constexpr int kPhotometricReach = kPhotometricRadius * kPhotometricChannels;
constexpr int kPhotometricRows = 4;   // filtered at a time: each value is loaded once for all of them
constexpr int kPhotometricRing = 16;  // rows of derivatives that stay in reach of the windows; a power of two
constexpr int kPhotometricLine = 16;  // floats in a cache line: vectors that straddle two cost twice
constexpr int kPhotometricPad = 64;   // room at both ends of a row buffer: the window's reach and whole vectors

// Some rows of a picture. Columns count floats; `left..right` is the box and `origin..limit` the box grown by the
// window's reach within the picture, which holds at least 16 floats. Row buffers begin at `origin`; beyond
// `limit` and, for derivatives, beyond the box, they hold zeros.
struct PhotometricBand {
  const float* image;   // [h, stride]
  const float* target;  // [h, stride]
  float* gradient;      // [h, stride] or null
  int64_t stride;
  int height;
  int top, bottom;                          // rows of the box
  int begin, end;                           // rows whose gradient and sums this band owns
  int left, right;                          // columns of the box
  int origin, limit;                        // columns of the grown box
  float l1_factor;                          // l1_weight / (h * stride)
  float ssim_factor;                        // ssim_weight / (h * stride)
  const float* weights;                     // [11], the window
  float* blurred[4][kPhotometricRows];      // filtered along columns: image, target, square sum, product
  float* derivatives[3][kPhotometricRows];  // filtered along columns: what the ring holds
  float* ring[3][kPhotometricRing];         // derivatives of the map with respect to mean, square sum and product
  float* zeros;                             // a row of them
  double* l1_sums;                          // [h]
  double* ssim_sums;                        // [h]
};

struct PhotometricKernels {
  void (*band)(const PhotometricBand&);
  void (*bytes_to_floats)(const uint8_t* from, int64_t count, float* to);  // 255 becomes 1
};

}  // namespace mien
