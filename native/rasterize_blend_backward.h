// Backward: one tile, again front to back. The colour behind a splat is the final colour less what was blended so far,
// so the forward pass stores nothing per pixel but the picture.
#pragma once

#include "rasterize_blend.h"
#include "rasterize_pixel_gradients.h"

namespace {

struct Sums {
  F red, green, blue, one, x, y, xx, xy, yy;
};

// What adds to splats' exponents, in one tile, for W entries of its list at once: with across and along the two roots
// at a pixel, alpha = 2^(log2_opacity - across^2 - along^2). Both are linear in the pixel's place: a part for the place
// in its block (BlockRoots) and a number for the block's column and row.
struct TileRoots {
  alignas(64) float across_columns[kTileBlocks][W], across_rows[kTileBlocks][W], along_rows[kTileBlocks][W];
  alignas(64) float slant[W];

  MIEN_INLINE TileRoots(const Splat* splats, const Entry* entries, int valid, float left, float top) {
    const float *places[W], *roots[W];
    for (int lane = 0; lane < W; ++lane) {
      const Splat& s = splats[entries[lane < valid ? lane : 0].gaussian];
      places[lane] = &s.x;
      roots[lane] = &s.root_sharpness;
    }
    F place[4], root[4];
    gather_columns<4>(places, place);
    gather_columns<4>(roots, root);
    const F slope = place[2], sharpness = root[0], falloff = root[1], slanted = sharpness * slope;
    const F dx = (left + 0.5f) - place[0], dy = (top + 0.5f) - place[1];
    const F across = sharpness * (dx - slope * dy), along = falloff * dy;
    for (int i = 0; i < kTileBlocks; ++i) {
      store(across_columns[i], across + sharpness * (float)(kBlock * i));
      store(across_rows[i], slanted * (float)(-kBlock * i));
      store(along_rows[i], along + falloff * (float)(kBlock * i));
    }
    store(slant, slanted);
  }
};

struct BlockRoots {
  F across[kVectors], along[kVectors];
  const TileRoots& tile;
  int lane;

  MIEN_INLINE BlockRoots(const Splat& s, const TileRoots& roots, int lane) : tile(roots), lane(lane) {
    for (int v = 0; v < kVectors; ++v) {
      across[v] = lane_x() * s.root_sharpness - lane_y(v) * roots.slant[lane];
      along[v] = lane_y(v) * s.root_falloff;
    }
  }
};

// A splat at the pixels of one vector.
struct Footprint {
  F across, along, alpha;

  MIEN_INLINE Footprint(const Splat& s, const BlockRoots& roots, int block, int v) {
    const int column = block % kTileBlocks, row = block / kTileBlocks, lane = roots.lane;
    across = (roots.across[v] + roots.tile.across_columns[column][lane]) + roots.tile.across_rows[row][lane];
    along = roots.along[v] + roots.tile.along_rows[row][lane];
    const F power = (s.log2_opacity - along * along) - across * across;
    alpha = keep(less_equal(set1(kLog2AlphaMin), power), exp2_alpha(power));
  }
};

// CLAMPED: whether alpha can reach kAlphaMax, where it no longer depends on the exponent.
template <bool CLAMPED>
MIEN_INLINE void add_vector(const Splat& s, const Footprint& f, int block, int v, TileGradients& t, Sums& sums) {
  const F product = load(t.product[block] + v * W), before = load(t.behind[block] + v * W);
  const F red = load(t.color[0][block] + v * W), green = load(t.color[1][block] + v * W);
  const F blue = load(t.color[2][block] + v * W);
  const F alpha = CLAMPED ? minimum(f.alpha, set1(kAlphaMax)) : f.alpha;
  const F share = product * alpha, next = product - share;
  const M open = less(set1(kTransmittanceMin), next);
  // Where the pixel has ended nothing reads these two any more: nothing has to wait for `open`.
  const F own = share * (s.red * red + s.green * green + s.blue * blue), behind = before - own;
  const M sensitive = CLAMPED ? both(open, less_equal(f.alpha, set1(kAlphaMax))) : open;
  const F value = keep(sensitive, own - behind * (alpha * reciprocal(1.0f - alpha)));
  store(t.product[block] + v * W, next);
  store(t.behind[block] + v * W, behind);
  sums.red = add_where(open, share, red, sums.red);
  sums.green = add_where(open, share, green, sums.green);
  sums.blue = add_where(open, share, blue, sums.blue);
  const F value_x = value * f.across, value_y = value * f.along;
  sums.one = sums.one + value;
  sums.x = sums.x + value_x;
  sums.y = sums.y + value_y;
  sums.xx = sums.xx + value_x * f.across;
  sums.xy = sums.xy + value_x * f.along;
  sums.yy = sums.yy + value_y * f.along;
}

MIEN_INLINE void store_moments(const Sums& s, Moments& slot) {
  const F eight[8] = {s.red, s.green, s.blue, s.one, s.x, s.y, s.xx, s.xy};
  F4 sums[2];
  sums_of_eight(eight, sums);
  memcpy(&slot.red, &sums[0], sizeof sums[0]);
  memcpy(&slot.x, &sums[1], sizeof sums[1]);
  slot.yy = sum(s.yy);
}

// The sums of one splat over the blocks of its mask (at least one). What a processor can look ahead is less than a
// block's chain of dependent operations; so the footprint in the next block comes before the sums of this one.
template <bool CLAMPED>
MIEN_INLINE void add_splat(const Splat& s, const BlockRoots& roots, uint64_t mask, TileGradients& t, Sums& result) {
  Sums sums{};
  for (int v = 0; v < kVectors; ++v) {
    int block = __builtin_ctzll(mask);
    Footprint footprint(s, roots, block, v);
    for (uint64_t left = mask & (mask - 1); left; left &= left - 1) {
      const int next = __builtin_ctzll(left);
      const Footprint later(s, roots, next, v);
      add_vector<CLAMPED>(s, footprint, block, v, t, sums);
      footprint = later;
      block = next;
    }
    add_vector<CLAMPED>(s, footprint, block, v, t, sums);
  }
  result = sums;
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
  // What the next tile needs comes into the cache meanwhile: its entries follow this tile's.
  const int next = tile + 1, tiles = lists.columns * lists.rows, all = lists.begins[tiles];
  PixelsAhead ahead(picture, view, next % lists.columns * kTile, next / lists.columns * kTile);
  if (next == tiles || lists.begins[next + 1] == end) ahead.stop();
  // A splat's sums over its lanes are taken after the next splat's: there they wait for nothing.
  Sums sums[2];
  Moments* waiting = nullptr;
  int current = 0;
  for (int i = begin; i < last; i += W) {
    const int valid = last - i < W ? last - i : W;
    const TileRoots tile_roots(splats, lists.entries + i, valid, (float)left, (float)top);
    for (int lane = 0; lane < valid; ++lane) {
      const Entry& entry = lists.entries[i + lane];
      const int remaining = all - (i + lane) - 1;
      __builtin_prefetch(&splats[(&entry)[remaining < kGatherAhead ? remaining : kGatherAhead].gaussian]);
      const Moments& later = slots[(&entry)[remaining < kAhead ? remaining : kAhead].slot];
      __builtin_prefetch(&later.red, 1);  // a slot may begin in one cache line and end in another
      __builtin_prefetch(&later.yy, 1);
      ahead.step();
      const Splat& s = splats[entry.gaussian];
      const uint64_t mask = lists.masks[i + lane];
      if (mask == 0) {
        memset(&slots[entry.slot], 0, sizeof(Moments));
        continue;
      }
      const BlockRoots roots(s, tile_roots, lane);
      if (s.log2_opacity < kLog2AlphaMax) {
        add_splat<false>(s, roots, mask, gradients, sums[current]);
      } else {
        add_splat<true>(s, roots, mask, gradients, sums[current]);
      }
      current ^= 1;
      if (waiting) store_moments(sums[current], *waiting);
      waiting = &slots[entry.slot];
    }
  }
  if (waiting) store_moments(sums[current ^ 1], *waiting);
  for (int i = last; i < end; ++i) memset(&slots[lists.entries[i].slot], 0, sizeof(Moments));
}

}  // namespace
