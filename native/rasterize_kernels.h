// The arguments of the kernels, which are compiled once per instruction set (rasterize_kernels.cpp).
#pragma once

#include <cstdint>

#include "rasterize.h"

namespace mien {

constexpr int kBlock = 4;       // a block is 4x4 pixels: the unit of work of the blend kernels
constexpr int kTileBlocks = 8;  // a tile is 8x8 blocks, 32x32 pixels: one bit of a 64-bit mask per block
constexpr int kTile = kBlock * kTileBlocks;
constexpr int kGroup = 256;  // Gaussians a project kernel handles at a time

constexpr float kNear = 0.01f;
constexpr float kDilation = 0.3f;
constexpr float kAlphaMax = 0.999f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kFovMargin = 0.3f;
constexpr float kLog2AlphaMax = -0.00146f;      // a little below log2(kAlphaMax)
constexpr float kLog2AlphaMin = -7.994353437f;  // log2(1 / 255)

// A projected Gaussian: one cache line. At (dx, dy) pixels from its centre and with across = dx - slope * dy,
// alpha = 2^(log2_opacity - (root_sharpness * across)^2 - (root_falloff * dy)^2). This is the usual inverse covariance
// with the square completed: it does not cancel for needles, is never negative and takes an operation less.
struct alignas(64) Splat {
  float x, y;  // centre, pixels
  // Where alpha is 1/255: at height dy the ellipse spans slope * dy +- sqrt(width2 * (1 - (dy / half_height)^2)).
  float slope, width2;
  float half_height;
  float y_rightmost;  // dy of the point that is farthest right; the leftmost is opposite
  float depth;        // camera z
  float inverse_half_height;
  // Roots of log2(e) / 2 times 1 / variance of x given y, and times 1 / variance of y.
  float root_sharpness, root_falloff;
  float log2_opacity;
  float red, green, blue, unused2[2];
};

// A (Gaussian, tile) pair in a tile's list, front to back.
struct Entry {
  uint32_t gaussian;
  uint32_t slot;  // where its gradient goes; the slots of a Gaussian are consecutive
};

// The sums over one tile's pixels, with v = dL/dalpha * alpha, x = root_sharpness * across and y = root_falloff * dy:
// the colours' gradients, then v times 1, x, y, x^2, x y and y^2.
struct Moments {
  float red, green, blue, one, x, y, xx, xy, yy, unused[3];
};

struct TileLists {
  const Entry* entries;
  uint64_t* masks;        // per entry: the blocks it is blended in (written by the forward pass); null: not needed
  const int32_t* begins;  // [tiles + 1]
  int32_t* ends;          // [tiles]: entries after this one changed no pixel (written by the forward pass)
  int columns, rows;
};

// Tiles per row of tiles that a splat touches, for the first two rows (most splats touch no more).
struct TileSpan {
  int16_t first_row, row_count;
  int16_t low[2], high[2];  // columns, inclusive; empty where high < low
};

struct TileGrid {
  int columns, rows;
};

// The depth keys of a group's Gaussians that are drawn.
struct DepthRange {
  int64_t drawn;
  uint32_t nearest, farthest;
};

// What projection writes for each Gaussian.
struct Projected {
  TileGrid grid;
  Splat* splats;
  TileSpan* spans;           // only where drawn
  uint32_t* slot_counts;     // tiles in a span's first two rows; 0: not drawn
  uint32_t* depth_keys;      // all ones: not drawn
  DepthRange* depth_ranges;  // per group
  int32_t* radii;
};

struct Kernels {
  // Gaussians first .. last - 1 of one group. False on NaN or infinity.
  bool (*project)(const GaussianArrays&, const View&, int64_t first, int64_t last, const Projected&);
  void (*blend)(const Splat*, const TileLists&, const View&, int tile, float* image, float* alpha);
  void (*blend_backward)(const Splat*, const TileLists&, const View&, int tile, const PictureGradient&, Moments*);
  // Gaussians first .. last - 1, whose slots lie from slot_begins[i] to slot_begins[i + 1]; view_gradient gets their
  // share.
  void (*project_backward)(const GaussianArrays&, const View&, int64_t first, int64_t last, const uint32_t* slot_begins,
                           const Moments*, const GaussianGradients&, float* view_gradient);
};

}  // namespace mien
