// A tile's pixels while they are blended, and how they get into the picture.
#pragma once

#include "rasterize_kernels.h"
#include "simd_columns.h"

namespace {

using namespace mien;

constexpr int kVectors = kBlock * kBlock / W;  // vectors per block
constexpr int kBlocks = kTileBlocks * kTileBlocks;
constexpr int kBlocksAhead = 4;  // blocks: how far ahead the picture is fetched before it is written

struct TilePixels {
  alignas(64) float transmittance[kBlocks][kBlock * kBlock];
  // Goes on falling where transmittance stays: at kTransmittanceMin the pixel ends. That keeps the dependence of each
  // splat on the one before it to one multiplication.
  alignas(64) float product[kBlocks][kBlock * kBlock];
  alignas(64) float color[3][kBlocks][kBlock * kBlock];
};

// Of a tile: where it lies in the picture, and where the picture lies.
struct TilePicture {
  const View& view;
  int left, top;
  float *image, *alpha;
};

// Fetches what will be written of a block into the cache; the block may lie anywhere.
MIEN_INLINE void prefetch_block(int block, const TilePicture& tile) {
  const int left = tile.left + kBlock * (block % kTileBlocks), top = tile.top + kBlock * (block / kTileBlocks);
  for (int y = top; y < top + kBlock; ++y) {
    const int64_t pixel = (int64_t)y * tile.view.width + left;
    __builtin_prefetch(tile.image + 3 * pixel, 1);
    __builtin_prefetch(tile.alpha + pixel, 1);
  }
}

MIEN_INLINE void write_block(const TilePixels& pixels, int block, const TilePicture& tile) {
  const View& view = tile.view;
  const int left = tile.left + kBlock * (block % kTileBlocks), top = tile.top + kBlock * (block / kTileBlocks);
  float *const image = tile.image, *const alpha = tile.alpha;
  const int rows = view.height - top < kBlock ? view.height - top : kBlock;
  const int columns = view.width - left < kBlock ? view.width - left : kBlock;
  if (rows == kBlock && columns == kBlock) {
    for (int v = 0; v < kVectors; ++v) {
      const int64_t pixel = (int64_t)(top + v * (W / kBlock)) * view.width + left;
      const F remaining = load(pixels.transmittance[block] + v * W);
      F color[3];
      for (int channel = 0; channel < 3; ++channel)
        color[channel] = load(pixels.color[channel][block] + v * W) + remaining * view.background[channel];
      join3(image + 3 * pixel, 3 * view.width, color[0], color[1], color[2]);
      store_fours(alpha + pixel, view.width, 1.0f - remaining);
    }
    return;
  }
  for (int row = 0; row < rows; ++row) {
    const int64_t pixel = (int64_t)(top + row) * view.width + left;
    for (int column = 0; column < columns; ++column) {
      const int lane = row * kBlock + column;
      const float remaining = pixels.transmittance[block][lane];
      for (int channel = 0; channel < 3; ++channel)
        image[3 * (pixel + column) + channel] =
            pixels.color[channel][block][lane] + remaining * view.background[channel];
      alpha[pixel + column] = 1.0f - remaining;
    }
  }
}

// A tile without splats.
void fill_background(const View& view, int left, int top, float* image, float* alpha) {
  const int bottom = top + kTile < view.height ? top + kTile : view.height;
  const int columns = view.width - left < kTile ? view.width - left : kTile;
  for (int y = top; y < bottom; ++y) {
    float* row = image + 3 * ((int64_t)y * view.width + left);
    for (int x = 0; x < columns; ++x)
      for (int channel = 0; channel < 3; ++channel) row[3 * x + channel] = view.background[channel];
    memset(alpha + (int64_t)y * view.width + left, 0, sizeof(float) * columns);
  }
}

// The blocks of a tile that lie (partly) in the picture.
MIEN_INLINE uint64_t blocks_in_picture(const View& view, int left, int top) {
  uint64_t inside = 0;
  for (int block = 0; block < kBlocks; ++block) {
    const int x = left + kBlock * (block % kTileBlocks), y = top + kBlock * (block / kTileBlocks);
    if (x < view.width && y < view.height) inside |= 1ull << block;
  }
  return inside;
}

}  // namespace
