// Depth order and tile lists: one sort of the Gaussians, then a counting sort of (Gaussian, tile) pairs by tile.
#include <algorithm>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <string>

#include "pool.h"
#include "rasterize_frame.h"

namespace mien {
namespace {

// Part `index` of `parts` of `count` elements.
struct Part {
  int64_t first, last;

  Part(int64_t count, int64_t index, int64_t parts) : first(count * index / parts), last(count * (index + 1) / parts) {}
};

// The input of the first pass of the sort: all Gaussians, including those that are not drawn.
struct Unsorted {
  const uint32_t* keys;
  uint32_t nearest;

  bool is_drawn(int64_t i) const { return keys[i] != UINT32_MAX; }
  // Depths of a head differ in few bits: sorting the differences to the nearest saves a pass.
  uint32_t key(int64_t i) const { return keys[i] - nearest; }
  uint32_t gaussian(int64_t i) const { return static_cast<uint32_t>(i); }
};

// The input of later passes: the output of the pass before.
struct Sorted {
  const uint32_t *keys, *order;

  bool is_drawn(int64_t) const { return true; }
  uint32_t key(int64_t i) const { return keys[i]; }
  uint32_t gaussian(int64_t i) const { return order[i]; }
};

struct Digit {
  int shift, bits;
  bool last;  // whether this is the last pass, whose keys are not needed any more

  uint32_t of(uint32_t key) const { return key >> shift & ((1u << bits) - 1); }
};

// One stable pass of a radix sort: each part counts its digits, then writes where the parts before it end.
template <typename Source>
void radix_pass(Frame& frame, const Source from, int64_t count, const Digit digit) {
  const int64_t parts = std::clamp<int64_t>(count / 4096, 1, thread_count());
  SortPart* own = frame.sort_parts.reserve(parts);
  parallel_for(parts, [&](int64_t index) {
    const Part part(count, index, parts);
    uint32_t* counts = own[index].counts;
    std::memset(counts, 0, sizeof(uint32_t) << digit.bits);
    for (int64_t i = part.first; i < part.last; ++i) {
      if (from.is_drawn(i)) ++counts[digit.of(from.key(i))];
    }
  });
  uint32_t total = 0;
  for (uint32_t value = 0; value < 1u << digit.bits; ++value) {
    for (int64_t index = 0; index < parts; ++index) {
      const uint32_t here = own[index].counts[value];
      own[index].counts[value] = total;
      total += here;
    }
  }
  uint32_t *to_keys = frame.scratch_keys.data(), *to_order = frame.scratch_order.data();
  parallel_for(parts, [&](int64_t index) {
    const Part part(count, index, parts);
    uint32_t* starts = own[index].counts;
    for (int64_t i = part.first; i < part.last; ++i) {
      if (!from.is_drawn(i)) continue;
      const uint32_t key = from.key(i), to = starts[digit.of(key)]++;
      if (!digit.last) to_keys[to] = key;
      to_order[to] = from.gaussian(i);
    }
  });
  frame.sorted_keys.swap(frame.scratch_keys);
  frame.order.swap(frame.scratch_order);
}

// The tiles of a splat in one row of tiles (the scalar twin of columns_touched in rasterize_project.h).
void row_span(const Splat& s, int row, int columns, int* low, int* high) {
  const float top = row * kTile + 0.5f - s.y, bottom = top + (kTile - 1);
  if (top > s.half_height || bottom < -s.half_height) {
    *low = 0;
    *high = -1;
    return;
  }
  const auto half = [&s](float y) {
    const float t = y / s.half_height;
    return std::sqrt(std::max(s.width2 * (1 - t * t), 0.0f));
  };
  const float right_y = std::clamp(s.y_rightmost, top, bottom), left_y = std::clamp(-s.y_rightmost, top, bottom);
  const float right = s.x + s.slope * right_y + half(right_y), left = s.x + s.slope * left_y - half(left_y);
  *low = static_cast<int>(std::clamp(std::ceil((left - (kTile - 0.5f)) / kTile), 0.0f, static_cast<float>(columns)));
  *high = static_cast<int>(std::clamp(std::floor((right - 0.5f) / kTile), -1.0f, static_cast<float>(columns - 1)));
}

// Calls body(first tile, number of tiles) for each row of tiles that a splat touches.
template <typename Body>
void for_rows(const Splat& splat, const TileSpan& span, int columns, Body&& body) {
  for (int row = 0; row < span.row_count; ++row) {
    int low, high;
    if (row < 2) {
      low = span.low[row];
      high = span.high[row];
    } else {
      row_span(splat, span.first_row + row, columns, &low, &high);
    }
    body((span.first_row + row) * columns + low, std::max(high - low + 1, 0));
  }
}

// The pairs of a splat that touches more than two rows of tiles or more than two tiles in a row.
void find_large(const Splat& splat, uint32_t gaussian, const TileSpan& span, int columns, Buffer<Pair>& pairs) {
  for_rows(splat, span, columns, [&](int first, int count) {
    Pair* out = pairs.extend(count);
    for (int tile = first; tile < first + count; ++tile) *out++ = {gaussian, static_cast<uint32_t>(tile)};
    pairs.advance(count);
  });
}

// Counts in 64 bits, before any pair is written, if the scene could have too many pairs at all.
void check_pair_count(Frame& frame) {
  if (frame.drawn * frame.columns * frame.rows <= kMostPairs) return;
  std::atomic<int64_t> pairs{0};
  parallel_for(static_cast<int64_t>(frame.chunks.size()), [&](int64_t c) {
    int64_t own = 0;
    for (int64_t rank = frame.chunks[c].first; rank < frame.chunks[c].last; ++rank) {
      const uint32_t gaussian = frame.order[rank];
      for_rows(frame.splats[gaussian], frame.spans[gaussian], frame.columns, [&](int, int count) { own += count; });
    }
    pairs += own;
  });
  if (pairs <= kMostPairs) return;
  throw std::length_error("too many pairs of a Gaussian and a tile that it touches: " + std::to_string(pairs) +
                          ", at most " + std::to_string(kMostPairs) +
                          "; take fewer or smaller Gaussians, or a smaller picture");
}

void find_pairs(BinChunk& chunk, Frame& frame) {
  const int64_t count = chunk.last - chunk.first;
  const uint32_t* order = frame.order.data() + chunk.first;
  const TileSpan* spans = frame.spans.data();
  Buffer<Pair>& pairs = chunk.pairs;
  pairs.clear();
  constexpr int64_t kAhead = 16;  // in depth order, Gaussians are scattered in memory
  for (int64_t i = 0; i < count; ++i) {
    const uint32_t gaussian = order[i];
    __builtin_prefetch(&spans[order[std::min(i + kAhead, count - 1)]]);
    const TileSpan& span = spans[gaussian];
    const int above = std::max(span.high[0] - span.low[0] + 1, 0), below = std::max(span.high[1] - span.low[1] + 1, 0);
    if (span.row_count <= 2 && above <= 2 && below <= 2) {
      // Without a branch on the number of tiles, which is as good as random: both are written, those that count stay.
      const uint32_t first = static_cast<uint32_t>(span.first_row * frame.columns);
      const uint32_t upper = first + static_cast<uint32_t>(span.low[0]);
      const uint32_t lower = first + static_cast<uint32_t>(frame.columns + span.low[1]);
      Pair* out = pairs.extend(4);
      out[0] = {gaussian, upper};
      out[1] = {gaussian, upper + 1};
      out[above] = {gaussian, lower};
      out[above + 1] = {gaussian, lower + 1};
      pairs.advance(above + below);
    } else {
      const int64_t before = pairs.size();
      find_large(frame.splats[gaussian], gaussian, span, frame.columns, pairs);
      frame.slot_counts[gaussian] = static_cast<uint32_t>(pairs.size() - before);
    }
  }
  const int tiles = frame.columns * frame.rows;
  int32_t* counts = chunk.counts.reserve(tiles);
  std::memset(counts, 0, sizeof(int32_t) * tiles);
  for (int64_t i = 0; i < pairs.size(); ++i) ++counts[pairs[i].tile];
}

// Where each chunk's entries go, tile by tile and within a tile in depth order.
void place_chunks(Frame& frame) {
  const int tiles = frame.columns * frame.rows;
  int32_t* begins = frame.tile_begins.reserve(tiles + 1);
  frame.tile_ends.reserve(tiles);
  int32_t total = 0;  // at most kMostPairs
  for (int tile = 0; tile < tiles; ++tile) {
    begins[tile] = total;
    for (BinChunk& chunk : frame.chunks) {
      const int32_t here = chunk.counts[tile];
      chunk.counts[tile] = total;
      total += here;
    }
  }
  begins[tiles] = total;
  frame.pairs = total;
}

// Divides the tiles into equal work for each thread, in runs that get shorter, so that no thread waits long for another
// at the end. The data of a run's next tile can be fetched ahead, and much of it is in the cache already.
void plan_runs(Frame& frame) {
  constexpr int64_t kEmptyTile = 16;  // takes as long as this many pairs
  constexpr int kRuns =
      12;  // per thread: each has a third of what is left of the thread's share, the last one the rest
  const int tiles = frame.columns * frame.rows, shares = thread_count();
  const int32_t* begins = frame.tile_begins.data();
  frame.runs = kRuns * shares;
  int32_t* run = frame.run_begins.reserve(frame.runs + 1);
  const auto work_before = [&](int tile) { return begins[tile] + kEmptyTile * tile; };
  int tile = 0;
  for (int share = 0; share < shares; ++share) {
    const int64_t end = work_before(tiles) * (share + 1) / shares;
    for (int i = 0; i < kRuns; ++i) {
      *run++ = tile;
      const int64_t begin = work_before(tile), wanted = i + 1 < kRuns ? begin + (end - begin) / 3 : end;
      while (tile < tiles && work_before(tile + 1) <= wanted) ++tile;
    }
  }
  *run = tiles;
}

// Slots in the order of the Gaussians, so that the projection's backward pass reads them one after the other.
void place_slots(Frame& frame, int64_t count) {
  const uint32_t* counts = frame.slot_counts.data();
  uint32_t* begins = frame.slot_begins.reserve(count + 1);
  const int64_t parts = std::clamp<int64_t>(count / 4096, 1, thread_count());
  uint32_t* totals = frame.slot_totals.reserve(parts);
  parallel_for(parts, [&](int64_t index) {
    const Part part(count, index, parts);
    uint32_t total = 0;
    for (int64_t i = part.first; i < part.last; ++i) total += counts[i];
    totals[index] = total;
  });
  parallel_for(parts, [&](int64_t index) {
    const Part part(count, index, parts);
    uint32_t total = 0;
    for (int64_t before = 0; before < index; ++before) total += totals[before];
    for (int64_t i = part.first; i < part.last; ++i) {
      begins[i] = total;
      total += counts[i];
    }
  });
  begins[count] = static_cast<uint32_t>(frame.pairs);
}

void fill_lists(BinChunk& chunk, Frame& frame) {
  Entry* entries = frame.entries.data();
  const uint32_t* slot_begins = frame.differentiable ? frame.slot_begins.data() : nullptr;
  Pair before{UINT32_MAX, 0};
  uint32_t earlier = 0;  // earlier pairs of the same Gaussian, which are adjacent
  for (int64_t i = 0; i < chunk.pairs.size(); ++i) {
    const Pair pair = chunk.pairs[i];
    earlier = pair.gaussian == before.gaussian ? earlier + 1 : 0;
    before = pair;
    entries[chunk.counts[pair.tile]++] = {pair.gaussian, slot_begins ? slot_begins[pair.gaussian] + earlier : 0};
  }
}

}  // namespace

void sort_by_depth(Frame& frame, int64_t count) {
  frame.drawn = 0;
  uint32_t nearest = UINT32_MAX, farthest = 0;
  for (int64_t group = 0; group < (count + kGroup - 1) / kGroup; ++group) {
    const DepthRange& range = frame.depth_ranges[group];
    frame.drawn += range.drawn;
    nearest = std::min(nearest, range.nearest);
    farthest = std::max(farthest, range.farthest);
  }
  if (frame.drawn == 0) return;
  for (auto* buffer : {&frame.sorted_keys, &frame.order, &frame.scratch_keys, &frame.scratch_order}) {
    buffer->reserve(frame.drawn);
  }
  // As few passes as possible, with equally many bits each.
  const int bits = std::max<int>(std::bit_width(farthest - nearest), 1);
  const int passes = (bits + kMostDigitBits - 1) / kMostDigitBits, digit = (bits + passes - 1) / passes;
  for (int pass = 0; pass < passes; ++pass) {
    const Digit own{pass * digit, digit, pass == passes - 1};
    if (pass == 0) {
      radix_pass(frame, Unsorted{frame.depth_keys.data(), nearest}, count, own);
    } else {
      radix_pass(frame, Sorted{frame.sorted_keys.data(), frame.order.data()}, frame.drawn, own);
    }
  }
}

void bin_into_tiles(Frame& frame, int64_t count) {
  const int64_t chunks = std::clamp<int64_t>(frame.drawn / 1024, 1, thread_count());
  while (static_cast<int64_t>(frame.chunks.size()) < chunks) frame.chunks.emplace_back();
  while (static_cast<int64_t>(frame.chunks.size()) > chunks) frame.chunks.pop_back();
  for (int64_t c = 0; c < chunks; ++c) {
    frame.chunks[c].first = frame.drawn * c / chunks;
    frame.chunks[c].last = frame.drawn * (c + 1) / chunks;
  }
  check_pair_count(frame);
  parallel_for(chunks, [&](int64_t c) { find_pairs(frame.chunks[c], frame); });
  place_chunks(frame);
  plan_runs(frame);
  if (frame.differentiable) place_slots(frame, count);
  frame.entries.reserve(frame.pairs);
  if (frame.differentiable) frame.masks.reserve(frame.pairs);
  parallel_for(chunks, [&](int64_t c) { fill_lists(frame.chunks[c], frame); });
}

}  // namespace mien
