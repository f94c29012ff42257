// Forward: one tile of the picture, front to back.
#pragma once

#include "rasterize_kernels.h"
#include "rasterize_project.h"
#include "simd_columns.h"

namespace {

using namespace mien;

constexpr int kVectors = kBlock * kBlock / W;  // vectors per block
constexpr int kBlocks = kTileBlocks * kTileBlocks;
constexpr int kBlocksAhead = 4;  // blocks: how far ahead the picture is fetched before it is written

struct TilePixels {
  alignas(64) float transmittance[kBlocks][kBlock * kBlock];
  // Keeps falling when transmittance stays, below kTransmittanceMin, where the pixel ends. So each splat depends on the
  // one before it by one multiplication only.
  alignas(64) float product[kBlocks][kBlock * kBlock];
  alignas(64) float color[3][kBlocks][kBlock * kBlock];
};

// A tile's place in the picture, and the picture.
struct TilePicture {
  const View& view;
  int left, top;
  float *image, *alpha;
};

// Fetches the pixels of a block into the cache before they are written. The block may be outside the picture.
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

constexpr int kGatherAhead = 32;  // entries: the same where little but their shapes is read
constexpr int kAhead = 8;         // entries: how far ahead their splats are fetched into the cache
constexpr int kChunk = 512;       // entries handled at a time: their splats stay in the cache

// Pixel centres of vector `v` of a block, relative to the block's first pixel centre.
MIEN_INLINE F lane_x() {
  F x;
  for (int lane = 0; lane < W; ++lane) x[lane] = (float)(lane % kBlock);
  return x;
}
MIEN_INLINE F lane_y(int v) {
  F y;
  for (int lane = 0; lane < W; ++lane) y[lane] = (float)(lane / kBlock + v * (W / kBlock));
  return y;
}

// The bits of the blocks of a row from the first of `rest` that are left to the end, and before `end`; both 0..8,
// truncated.
MIEN_INLINE I bits_between(F rest, F end) {
#if defined(__AVX2__)
  const I bits = (set1i(1) << truncate(end)) - (set1i(1 << kTileBlocks) >> truncate(rest));
#else  // no shifts by lane: through the exponents
  const I above = (truncate(end) + 127) << 23, below = (127 + kTileBlocks - truncate(rest)) << 23;
  const I bits = truncate(from_bits(above) - from_bits(below));
#endif
  return bits & ~(bits >> 31);
}

// The blocks of a tile that some entries of its list touch, one bit each.
struct BlockBits {
  alignas(64) uint8_t rows[kTileBlocks][kChunk];  // by row of blocks and entry; 0 from the last entry on

  // The same by entry, of the blocks in `live`.
  MIEN_INLINE void store_masks(int count, uint64_t live, uint64_t* masks) const {
    for (int i = 0; i < count; i += 16) {
      uint64_t found[16];
      transpose_bytes(rows[0] + i, kChunk, found);
      for (int j = 0; j < 16; ++j) found[j] &= live;
      memcpy(masks + i, found, sizeof(uint64_t) * (count - i < 16 ? count - i : 16));
    }
  }
};

void find_blocks(const Splat* splats, const Entry* entries, int count, float left, float top, BlockBits& found) {
  for (int i = 0; i < count; i += W) {
    const int valid = count - i < W ? count - i : W;
    const Splat* chosen[W];
    for (int lane = 0; lane < W; ++lane) chosen[lane] = &splats[entries[i + (lane < valid ? lane : 0)].gaussian];
    for (int later = i + kGatherAhead; later < i + kGatherAhead + W && later < count; ++later)
      __builtin_prefetch(&splats[entries[later].gaussian]);
    const SplatShape s = gather_shapes(chosen);
    const M valid_lanes = less(iota(), set1((float)valid));
    const Strips strips(s, (left + 0.5f) - s.x, kBlock, set1(kTileBlocks));
    const F first_y = (top + 0.5f) - s.y;
    for (int row = 0; row < kTileBlocks; ++row) {
      const F strip = first_y + (float)(kBlock * row);
      F end, rest;
      strips.touch(strip, strip + (kBlock - 1.0f), &end, &rest);
      const F there = clamp(keep(valid_lanes, end), F{}, set1(kTileBlocks));
      store_bytes(found.rows[row] + i, bits_between(clamp(rest, F{}, set1(kTileBlocks)), there));
    }
  }
  const int written = (count + W - 1) / W * W, used = (count + 63) / 64 * 64;
  for (int row = 0; row < kTileBlocks; ++row) memset(found.rows[row] + written, 0, used - written);
}

// The entries of a chunk that touch one block: 64 to a word, words without any left out.
struct Chosen {
  int words = 0, count = 0;
  int begins[kChunk / 64 + 1];
  uint64_t bits[kChunk / 64 + 1];

  MIEN_INLINE Chosen(const BlockBits& found, int entries, int block) {
    for (int i = 0; i < entries; i += 64) {
      const uint64_t own = bit_column(found.rows[block / kTileBlocks] + i, block % kTileBlocks);
      begins[words] = i;
      bits[words] = own;
      words += own != 0;
      count += __builtin_popcountll(own);
    }
    begins[words] = 0;
    bits[words] = 3;  // read once beyond the last, not used
  }
};

// Goes through the entries that were chosen.
struct Walk {
  const Chosen& chosen;
  uint64_t bits;
  int word = 0;

  MIEN_INLINE explicit Walk(const Chosen& chosen) : chosen(chosen), bits(chosen.bits[0]) {}
  MIEN_INLINE int next() {
    const int entry = chosen.begins[word] + __builtin_ctzll(bits);
    bits &= bits - 1;
    word += bits == 0;
    bits = bits ? bits : chosen.bits[word];
    return entry;
  }
};

MIEN_INLINE F alpha_at(const Splat& s, F px, F py) {
  const F dy = py - s.y, across = (px - s.x) - s.slope * dy;
  const F a = s.root_sharpness * across, b = s.root_falloff * dy;
  const F power = (s.log2_opacity - b * b) - a * a;
  return keep(less_equal(set1(kLog2AlphaMin), power), minimum(exp2_alpha(power), set1(kAlphaMax)));
}

// Blends entries of one chunk (at least one) into vector `v` of a block. Returns the last one looked at if all pixels
// of the vector ended there, otherwise kChunk. A splat's alpha is found while the one before it is blended: together
// they are a longer chain of dependent operations than a processor looks ahead.
MIEN_INLINE int blend_vector(const Splat* splats, const Entry* entries, const Chosen& chosen, float x, float y,
                             int block, int v, TilePixels& pixels) {
  F transmittance = load(pixels.transmittance[block] + v * W), product = load(pixels.product[block] + v * W);
  F red = load(pixels.color[0][block] + v * W), green = load(pixels.color[1][block] + v * W);
  F blue = load(pixels.color[2][block] + v * W);
  const F px = lane_x() + x, py = lane_y(v) + y;
  Walk walk(chosen);
  int entry = walk.next(), ended = kChunk;
  const Splat* s = &splats[entries[entry].gaussian];
  F alpha = alpha_at(*s, px, py);
  for (int left = chosen.count; left > 0; --left) {
    const int later = walk.next();
    const Splat* const following = &splats[entries[later].gaussian];
    const F later_alpha = alpha_at(*following, px, py);
    const F share = product * alpha, next = product - share;
    const M open = less(set1(kTransmittanceMin), next);
    red = add_where(open, share, set1(s->red), red);
    green = add_where(open, share, set1(s->green), green);
    blue = add_where(open, share, set1(s->blue), blue);
    transmittance = select(open, next, transmittance);
    product = next;
    if (!any(open)) {
      ended = entry;
      break;
    }
    entry = later;
    s = following;
    alpha = later_alpha;
  }
  store(pixels.transmittance[block] + v * W, transmittance);
  store(pixels.product[block] + v * W, product);
  store(pixels.color[0][block] + v * W, red);
  store(pixels.color[1][block] + v * W, green);
  store(pixels.color[2][block] + v * W, blue);
  return ended;
}

// Blends the first `count` of `available` entries into all blocks in `live`; stores which entry was blended into which
// blocks. With the last entries the blocks in `unwritten` are written: processors write while they blend the next
// block. Returns what is live, and leaves what is unwritten.
MIEN_INLINE uint64_t blend_chunk(const Splat* splats, const Entry* entries, int count, int available, uint64_t live,
                                 uint64_t* unwritten, uint64_t* masks, const TilePicture& tile, TilePixels& pixels) {
  BlockBits found;
  const float left = (float)tile.left, top = (float)tile.top;
  find_blocks(splats, entries, count, left, top, found);
  const uint64_t live_before = live;
  int ahead = count;  // the next chunk comes into the cache while there is work at hand
  const int ahead_end = available < count + kChunk ? available : count + kChunk;
  for (uint64_t blocks = live; blocks; blocks &= blocks - 1) {
    const int block = __builtin_ctzll(blocks);
    for (int i = 0; i < kAhead && ahead < ahead_end; ++i) __builtin_prefetch(&splats[entries[ahead++].gaussian]);
    const Chosen chosen(found, count, block);
    if (chosen.count != 0) {
      const float x = left + 0.5f + kBlock * (block % kTileBlocks), y = top + 0.5f + kBlock * (block / kTileBlocks);
      int ended = 0;
      for (int v = 0; v < kVectors; ++v) {
        const int here = blend_vector(splats, entries, chosen, x, y, block, v, pixels);
        ended = ended < here ? here : ended;
      }
      if (ended != kChunk) {
        live &= ~(1ull << block);
        uint8_t* row = found.rows[block / kTileBlocks];
        for (int i = ended + 1; i < count; ++i) row[i] &= (uint8_t)~(1u << block % kTileBlocks);
      }
    }
    if (count == available) {
      prefetch_block(block + kBlocksAhead, tile);
      write_block(pixels, block, tile);
      *unwritten &= ~(1ull << block);
    }
  }
  if (masks) found.store_masks(count, live_before, masks);
  return live;
}

void blend(const Splat* splats, const TileLists& lists, const View& view, int tile, float* image, float* alpha) {
  const int left = tile % lists.columns * kTile, top = tile / lists.columns * kTile;
  const int begin = lists.begins[tile], end = lists.begins[tile + 1];
  if (begin == end) {
    lists.ends[tile] = end;
    fill_background(view, left, top, image, alpha);
    return;
  }
  for (int i = begin; i < end && i < begin + kGatherAhead; ++i) __builtin_prefetch(&splats[lists.entries[i].gaussian]);
  [[maybe_unused]] const NoDenormals guard;
  TilePixels pixels;
  memset(pixels.color, 0, sizeof pixels.color);
  for (int block = 0; block < kBlocks; ++block) {
    for (int v = 0; v < kVectors; ++v) {
      store(pixels.transmittance[block] + v * W, set1(1.0f));
      store(pixels.product[block] + v * W, set1(1.0f));
    }
  }
  const TilePicture picture{view, left, top, image, alpha};
  uint64_t unwritten = blocks_in_picture(view, left, top), live = unwritten;
  int i = begin;
  while (i < end && live) {
    const int count = end - i < kChunk ? end - i : kChunk;
    live = blend_chunk(splats, lists.entries + i, count, end - i, live, &unwritten,
                       lists.masks ? lists.masks + i : nullptr, picture, pixels);
    i += count;
  }
  lists.ends[tile] = i;
  for (; unwritten; unwritten &= unwritten - 1) write_block(pixels, __builtin_ctzll(unwritten), picture);
}

}  // namespace
