// Backward: what is known of a tile's pixels before any splat.
#pragma once

#include "rasterize_pixels.h"

namespace {

struct TileGradients {
  alignas(64) float product[kBlocks][kBlock * kBlock];   // as in the forward pass
  alignas(64) float behind[kBlocks][kBlock * kBlock];    // gradient . (colour behind what has been blended)
  alignas(64) float color[3][kBlocks][kBlock * kBlock];  // dL / d image
};

// One pixel's gradients; returns the bits that are set in any of them.
MIEN_INLINE uint32_t load_pixel(const PictureGradient& p, int64_t pixel, int block, int lane, TileGradients& t) {
  const float grad_alpha = p.grad_alpha ? p.grad_alpha[pixel] : 0.0f;
  float behind = -grad_alpha * (1.0f - p.alpha[pixel]);
  uint32_t bits, any;
  memcpy(&any, &grad_alpha, sizeof any);
  for (int channel = 0; channel < 3; ++channel) {
    const float gradient = p.grad_image[3 * pixel + channel];
    t.color[channel][block][lane] = gradient;
    behind += gradient * p.image[3 * pixel + channel];
    memcpy(&bits, &gradient, sizeof bits);
    any |= bits;
  }
  t.behind[block][lane] = behind;
  return any;
}

// A block that lies in the picture, from its first pixel on.
MIEN_INLINE I load_block(const PictureGradient& p, int64_t pixel, int width, int block, TileGradients& t) {
  I any{};
  for (int v = 0; v < kVectors; ++v, pixel += (int64_t)(W / kBlock) * width) {
    F gradient[3], color[3], behind{};
    split3(p.grad_image + 3 * pixel, 3 * width, gradient);
    split3(p.image + 3 * pixel, 3 * width, color);
    if (p.grad_alpha) {  // without one, alpha need not come from memory
      const F grad_alpha = load_fours(p.grad_alpha + pixel, width);
      behind = -grad_alpha * (1.0f - load_fours(p.alpha + pixel, width));
      any |= bits(grad_alpha);
    }
    for (int channel = 0; channel < 3; ++channel) {
      store(t.color[channel][block] + v * W, gradient[channel]);
      behind = behind + gradient[channel] * color[channel];
      any |= bits(gradient[channel]);
    }
    store(t.behind[block] + v * W, behind);
  }
  return any;
}

// Fetches the pixels of a tile into the cache, from the first row to the last, in small steps between other work.
class PixelsAhead {
 public:
  static constexpr int kRowSteps = 3 * kTile / 16;

  MIEN_INLINE PixelsAhead(const PictureGradient& picture, const View& view, int left, int top)
      : picture_(picture), pixel_((int64_t)top * view.width + left), width_(view.width) {
    rows_ = view.height - top < kTile ? view.height - top : kTile;
    columns_ = view.width - left < kTile ? view.width - left : kTile;
  }
  MIEN_INLINE void step() {
    if (rows_ <= 0) return;
    __builtin_prefetch(picture_.grad_image + 3 * pixel_ + x_);
    __builtin_prefetch(picture_.image + 3 * pixel_ + x_);
    x_ += 16;
    if (x_ < 3 * columns_) return;
    x_ = 0;
    pixel_ += width_;
    --rows_;
  }
  void stop() { rows_ = 0; }

 private:
  const PictureGradient& picture_;
  int64_t pixel_;
  int width_, rows_, columns_, x_ = 0;
};

// Loads the gradients of a tile; false if all are zero.
MIEN_INLINE bool load_gradients(const PictureGradient& p, const View& view, int left, int top, TileGradients& t) {
  const int rows = view.height - top < kTile ? view.height - top : kTile;
  const int columns = view.width - left < kTile ? view.width - left : kTile;
  PixelsAhead ahead(p, view, left, top);
  for (int i = 0; i < 2 * kBlock * PixelsAhead::kRowSteps; ++i) ahead.step();
  for (int block = 0; block < kBlocks; ++block)
    for (int v = 0; v < kVectors; ++v) store(t.product[block] + v * W, set1(1.0f));
  if (rows < kTile || columns < kTile) {
    memset(t.behind, 0, sizeof t.behind);
    memset(t.color, 0, sizeof t.color);
  }
  I any_block{};
  uint32_t any_pixel = 0;
  for (int y = 0; y < rows; y += kBlock) {
    for (int x = 0; x < columns; x += kBlock) {
      for (int i = 0; i < kBlock * PixelsAhead::kRowSteps / kTileBlocks; ++i) ahead.step();
      const int block = y / kBlock * kTileBlocks + x / kBlock;
      const int64_t pixel = (int64_t)(top + y) * view.width + left + x;
      if (rows - y >= kBlock && columns - x >= kBlock) {
        any_block |= load_block(p, pixel, view.width, block, t);
        continue;
      }
      for (int row = 0; row < kBlock && row < rows - y; ++row)
        for (int column = 0; column < kBlock && column < columns - x; ++column)
          any_pixel |= load_pixel(p, pixel + (int64_t)row * view.width + column, block, row * kBlock + column, t);
    }
  }
  for (int lane = 0; lane < W; ++lane) any_pixel |= (uint32_t)any_block[lane];
  return (any_pixel & 0x7fffffff) != 0;
}

}  // namespace
