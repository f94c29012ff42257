// Backward: one tile, again front to back. The colour behind a splat is the final colour less what was blended so far,
// so the forward pass stores nothing per pixel but the picture.
#pragma once

#include "rasterize_blend.h"

namespace {

struct TileGradients {
  alignas(64) float product[kBlocks][kBlock * kBlock];   // as in the forward pass
  alignas(64) float behind[kBlocks][kBlock * kBlock];    // gradient . (colour behind what has been blended)
  alignas(64) float color[3][kBlocks][kBlock * kBlock];  // dL / d image
};

// One pixel's gradients; returns their absolute sum.
MIEN_INLINE float load_pixel(const PictureGradient& p, int64_t pixel, int block, int lane, TileGradients& t) {
  const float grad_alpha = p.grad_alpha ? p.grad_alpha[pixel] : 0.0f;
  float behind = -grad_alpha * (1.0f - p.alpha[pixel]), size = __builtin_fabsf(grad_alpha);
  for (int channel = 0; channel < 3; ++channel) {
    const float gradient = p.grad_image[3 * pixel + channel];
    t.color[channel][block][lane] = gradient;
    behind += gradient * p.image[3 * pixel + channel];
    size += __builtin_fabsf(gradient);
  }
  t.behind[block][lane] = behind;
  return size;
}

MIEN_INLINE F4 magnitude(F4 value) {
  typedef int32_t I4 __attribute__((vector_size(16)));
  return (F4)((I4)value & 0x7fffffff);
}

// Four pixels in a row, from the first lane of a block's row on.
MIEN_INLINE F4 load_four(const PictureGradient& p, int64_t pixel, int block, int lane, TileGradients& t) {
  F4 gradient[3], color[3];
  split3(p.grad_image + 3 * pixel, gradient);
  split3(p.image + 3 * pixel, color);
  const F4 grad_alpha = p.grad_alpha ? load4(p.grad_alpha + pixel) : F4{};
  F4 behind = -grad_alpha * (1.0f - load4(p.alpha + pixel)), size = magnitude(grad_alpha);
  for (int channel = 0; channel < 3; ++channel) {
    store4(&t.color[channel][block][lane], gradient[channel]);
    behind = behind + gradient[channel] * color[channel];
    size = size + magnitude(gradient[channel]);
  }
  store4(&t.behind[block][lane], behind);
  return size;
}

MIEN_INLINE void prefetch_row(const PictureGradient& p, int64_t pixel, int columns) {
  for (int x = 0; x < 3 * columns; x += 16) {
    __builtin_prefetch(p.grad_image + 3 * pixel + x);
    __builtin_prefetch(p.image + 3 * pixel + x);
  }
  for (int x = 0; x < columns; x += 16) __builtin_prefetch(p.alpha + pixel + x);
}

// Loads the gradients of a tile; false if all are zero.
MIEN_INLINE bool load_gradients(const PictureGradient& p, const View& view, int left, int top, TileGradients& t) {
  const int rows = view.height - top < kTile ? view.height - top : kTile;
  const int columns = view.width - left < kTile ? view.width - left : kTile;
  for (int block = 0; block < kBlocks; ++block)
    for (int v = 0; v < kVectors; ++v) store(t.product[block] + v * W, set1(1.0f));
  if (rows < kTile || columns < kTile) {
    memset(t.behind, 0, sizeof t.behind);
    memset(t.color, 0, sizeof t.color);
  }
  F4 size{};
  for (int y = 0; y < rows; ++y) {
    const int64_t pixel = (int64_t)(top + y) * view.width + left;
    const int first_block = y / kBlock * kTileBlocks, first_lane = y % kBlock * kBlock;
    prefetch_row(p, pixel + (int64_t)(y + 2 < rows ? 2 : 0) * view.width, columns);
    int x = 0;
    for (; x + kBlock <= columns; x += kBlock)
      size = size + load_four(p, pixel + x, first_block + x / kBlock, first_lane, t);
    for (; x < columns; ++x) size[0] += load_pixel(p, pixel + x, first_block + x / kBlock, first_lane + x % kBlock, t);
  }
  return !(size[0] + size[1] + size[2] + size[3] == 0.0f);
}

struct Sums {
  F red, green, blue, one, x, y, xx, xy, yy;
};

// What adds to a splat's exponent, in one tile: with across and along the two roots at a pixel, alpha = 2^(log2_opacity
// - across^2 - along^2). Both are linear in the pixel's place: a part for the place in a block and one for the block's.
struct TileRoots {
  F across[kVectors], along[kVectors];
  float across_columns[kTileBlocks], across_rows[kTileBlocks], along_rows[kTileBlocks];

  MIEN_INLINE TileRoots(const Splat& s, float left, float top) {
    const float dy = top + 0.5f - s.y, slant = s.root_sharpness * s.slope;
    const float first_across = s.root_sharpness * ((left + 0.5f - s.x) - s.slope * dy);
    const float first_along = s.root_falloff * dy;
    for (int v = 0; v < kVectors; ++v) {
      across[v] = lane_x() * s.root_sharpness - lane_y(v) * slant;
      along[v] = lane_y(v) * s.root_falloff;
    }
    for (int i = 0; i < kTileBlocks; ++i) {
      across_columns[i] = first_across + s.root_sharpness * (float)(kBlock * i);
      across_rows[i] = slant * (float)(-kBlock * i);
      along_rows[i] = first_along + s.root_falloff * (float)(kBlock * i);
    }
  }
};

// CLAMPED: whether alpha can reach kAlphaMax, where it no longer depends on the exponent.
template <bool CLAMPED>
MIEN_INLINE void add_vector(const Splat& s, F across, F along, int block, int v, TileGradients& t, Sums& sums) {
  const F product = load(t.product[block] + v * W), before = load(t.behind[block] + v * W);
  const F red = load(t.color[0][block] + v * W), green = load(t.color[1][block] + v * W);
  const F blue = load(t.color[2][block] + v * W);
  const F power = (s.log2_opacity - across * across) - along * along;
  const M seen = less_equal(set1(kLog2AlphaMin), power);
  const F raw = exp2_alpha(power);
  const F alpha = keep(seen, CLAMPED ? minimum(raw, set1(kAlphaMax)) : raw);
  const F share = product * alpha, next = product - share;
  const M open = less(set1(kTransmittanceMin), next);
  const F weight = keep(open, share);
  const F own = weight * (s.red * red + s.green * green + s.blue * blue);
  const F behind = before - own;
  const M sensitive = CLAMPED ? both(open, less_equal(raw, set1(kAlphaMax))) : open;
  const F value = keep(sensitive, own - behind * alpha * reciprocal(1.0f - alpha));
  store(t.product[block] + v * W, next);
  store(t.behind[block] + v * W, behind);
  sums.red = sums.red + weight * red;
  sums.green = sums.green + weight * green;
  sums.blue = sums.blue + weight * blue;
  const F value_x = value * across, value_y = value * along;
  sums.one = sums.one + value;
  sums.x = sums.x + value_x;
  sums.y = sums.y + value_y;
  sums.xx = sums.xx + value_x * across;
  sums.xy = sums.xy + value_x * along;
  sums.yy = sums.yy + value_y * along;
}

MIEN_INLINE void store_moments(const Sums& s, Moments& slot) {
  const F eight[8] = {s.red, s.green, s.blue, s.one, s.x, s.y, s.xx, s.xy};
  F4 sums[2];
  sums_of_eight(eight, sums);
  memcpy(&slot.red, &sums[0], sizeof sums[0]);
  memcpy(&slot.x, &sums[1], sizeof sums[1]);
  slot.yy = sum(s.yy);
}

// The moments of one splat in the blocks of its mask.
template <bool CLAMPED>
MIEN_INLINE void add_splat(const Splat& s, float left, float top, uint64_t mask, TileGradients& t, Moments& slot) {
  const TileRoots roots(s, left, top);
  Sums sums{};
  for (; mask; mask &= mask - 1) {
    const int block = __builtin_ctzll(mask), column = block % kTileBlocks, row = block / kTileBlocks;
    for (int v = 0; v < kVectors; ++v) {
      const F across = (roots.across[v] + roots.across_columns[column]) + roots.across_rows[row];
      add_vector<CLAMPED>(s, across, roots.along[v] + roots.along_rows[row], block, v, t, sums);
    }
  }
  store_moments(sums, slot);
}

void blend_backward(const Splat* splats, const TileLists& lists, const View& view, int tile,
                    const PictureGradient& picture, Moments* slots) {
  const int left = tile % lists.columns * kTile, top = tile / lists.columns * kTile;
  const int begin = lists.begins[tile], end = lists.begins[tile + 1];
  if (begin == end) return;
  [[maybe_unused]] const NoDenormals guard;
  TileGradients gradients;
  const bool needed = load_gradients(picture, view, left, top, gradients);
  const int last = needed ? lists.ends[tile] : begin;
  for (int i = begin; i < last; ++i) {
    const Splat& s = splats[lists.entries[i].gaussian];
    const Entry& ahead = lists.entries[i + kAhead < last ? i + kAhead : i];
    __builtin_prefetch(&splats[ahead.gaussian]);
    __builtin_prefetch(&slots[ahead.slot], 1);
    Moments& slot = slots[lists.entries[i].slot];
    if (s.log2_opacity < kLog2AlphaMax) {
      add_splat<false>(s, (float)left, (float)top, lists.masks[i], gradients, slot);
    } else {
      add_splat<true>(s, (float)left, (float)top, lists.masks[i], gradients, slot);
    }
  }
  for (int i = last; i < end; ++i) memset(&slots[lists.entries[i].slot], 0, sizeof(Moments));
}

}  // namespace
