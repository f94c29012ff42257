// Backward: one tile, again front to back. The colour behind a splat is the final colour minus what was blended so far,
// so the forward pass stores nothing per pixel except the picture.
#pragma once

#include "rasterize_blend.h"

namespace {

// Gradients of a tile's pixels, and their state before the first splat.
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
    if (p.grad_alpha) {  // without it, alpha is not read from memory
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
