// Backward: one tile, again front to back. The colour behind a splat is the final colour less what was blended so far,
// so the forward pass stores nothing per pixel but the picture.
#pragma once

#include "rasterize_blend.h"

namespace {

struct TileGradients {
  alignas(64) float open[kBlocks][kBlock * kBlock];      // transmittance, 0 once the pixel has ended
  alignas(64) float behind[kBlocks][kBlock * kBlock];    // gradient . (colour behind what has been blended)
  alignas(64) float color[3][kBlocks][kBlock * kBlock];  // dL / d image
};

// Loads the gradients of a tile; false if all are zero.
MIEN_INLINE bool load_gradients(const PictureGradient& p, const View& view, int left, int top, TileGradients& t) {
  memset(&t, 0, sizeof t);
  const int rows = view.height - top < kTile ? view.height - top : kTile;
  const int columns = view.width - left < kTile ? view.width - left : kTile;
  float largest = 0;
  for (int y = 0; y < rows; ++y) {
    for (int x = 0; x < columns; ++x) {
      const int64_t pixel = (int64_t)(top + y) * view.width + left + x;
      const int block = y / kBlock * kTileBlocks + x / kBlock, lane = y % kBlock * kBlock + x % kBlock;
      float behind = p.grad_alpha ? -p.grad_alpha[pixel] * (1.0f - p.alpha[pixel]) : 0.0f;
      float size = p.grad_alpha ? __builtin_fabsf(p.grad_alpha[pixel]) : 0.0f;
      for (int channel = 0; channel < 3; ++channel) {
        const float gradient = p.grad_image[3 * pixel + channel];
        t.color[channel][block][lane] = gradient;
        behind += gradient * p.image[3 * pixel + channel];
        size += __builtin_fabsf(gradient);
      }
      t.open[block][lane] = 1.0f;
      t.behind[block][lane] = behind;
      largest += size;
    }
  }
  return !(largest == 0.0f);
}

struct Sums {
  F red, green, blue, one, x, y, xx, xy, yy;
};

MIEN_INLINE void add_vector(const Splat& s, F px, F py, int block, int v, TileGradients& t, Sums& sums) {
  F open = load(t.open[block] + v * W), behind = load(t.behind[block] + v * W);
  const F red = load(t.color[0][block] + v * W), green = load(t.color[1][block] + v * W);
  const F blue = load(t.color[2][block] + v * W);
  const F dx = px - s.x, dy = py - s.y;
  const F power = s.log2_opacity - (dx * (s.xx * dx + 2.0f * s.xy * dy) + s.yy * (dy * dy));
  const F raw = exp2_fast(maximum(power, set1(-20.0f)));
  const F alpha = minimum(raw, set1(kAlphaMax));
  const F next = open - open * alpha;
  const M seen = less_equal(set1(kLog2AlphaMin), power);
  const M blended = both(seen, less(set1(kTransmittanceMin), next));
  const F weight = keep(blended, open * alpha);
  const F own = weight * (s.red * red + s.green * green + s.blue * blue);
  behind = behind - own;
  const M sensitive = both(blended, less_equal(raw, set1(kAlphaMax)));
  const F value = keep(sensitive, own - behind * alpha * reciprocal(1.0f - alpha));
  store(t.open[block] + v * W, select(seen, keep(blended, next), open));
  store(t.behind[block] + v * W, behind);
  sums.red = sums.red + weight * red;
  sums.green = sums.green + weight * green;
  sums.blue = sums.blue + weight * blue;
  const F value_x = value * dx, value_y = value * dy;
  sums.one = sums.one + value;
  sums.x = sums.x + value_x;
  sums.y = sums.y + value_y;
  sums.xx = sums.xx + value_x * dx;
  sums.xy = sums.xy + value_x * dy;
  sums.yy = sums.yy + value_y * dy;
}

void blend_backward(const Splat* splats, const TileLists& lists, const View& view, int tile,
                    const PictureGradient& picture, Moments* slots) {
  const int left = tile % lists.columns * kTile, top = tile / lists.columns * kTile;
  const int begin = lists.begins[tile], end = lists.begins[tile + 1];
  if (begin == end) return;
  TileGradients gradients;
  const bool needed = load_gradients(picture, view, left, top, gradients);
  const int last = needed ? lists.ends[tile] : begin;
  for (int i = begin; i < last; ++i) {
    const Splat& s = splats[lists.entries[i].gaussian];
    Sums sums{};
    for (uint64_t mask = lists.masks[i]; mask; mask &= mask - 1) {
      const int block = __builtin_ctzll(mask);
      const F px = lane_x() + (left + 0.5f + kBlock * (block % kTileBlocks));
      for (int v = 0; v < kVectors; ++v) {
        const F py = lane_y(v) + (top + 0.5f + kBlock * (block / kTileBlocks));
        add_vector(s, px, py, block, v, gradients, sums);
      }
    }
    slots[lists.entries[i].slot] = {sum(sums.red), sum(sums.green), sum(sums.blue), sum(sums.one), sum(sums.x),
                                    sum(sums.y),   sum(sums.xx),    sum(sums.xy),   sum(sums.yy),  {}};
  }
  for (int i = last; i < end; ++i) memset(&slots[lists.entries[i].slot], 0, sizeof(Moments));
}

}  // namespace
