// The buffers of one forward pass, and the steps on them that need no vector instructions.
#pragma once

#include <algorithm>
#include <deque>
#include <mutex>
#include <new>
#include <utility>

#include "memory.h"
#include "rasterize_kernels.h"

namespace mien {

// An array that only grows and is never cleared: page faults on fresh memory cost as much as the work.
template <typename T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { free_aligned(data_); }

  // At least `count` elements, never null. Their values may be lost.
  T* reserve(int64_t count) {
    if (count > capacity_ || !data_) {
      free_aligned(data_);
      capacity_ = count + count / 4 + 64;
      const size_t bytes = (sizeof(T) * static_cast<size_t>(capacity_) + 63) / 64 * 64;
      data_ = static_cast<T*>(allocate_aligned(bytes));
      if (!data_) {
        capacity_ = 0;
        throw std::bad_alloc();
      }
    }
    return data_;
  }
  // Where the next `count` elements go; keeps what is there. `advance` says how many of them were written.
  T* extend(int64_t count) {
    if (size_ + count > capacity_) grow(count);
    return data_ + size_;
  }
  void advance(int64_t count) { size_ += count; }
  void clear() { size_ = 0; }
  void swap(Buffer& other) {
    std::swap(data_, other.data_);
    std::swap(capacity_, other.capacity_);
    std::swap(size_, other.size_);
  }
  int64_t size() const { return size_; }
  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](int64_t index) { return data_[index]; }

 private:
  void grow(int64_t count) {
    Buffer larger;
    larger.reserve(2 * capacity_ + count + 1024);
    std::copy(data_, data_ + size_, larger.data_);
    std::swap(data_, larger.data_);
    std::swap(capacity_, larger.capacity_);
  }

  T* data_ = nullptr;
  int64_t capacity_ = 0, size_ = 0;
};

// A (Gaussian, tile) pair before it is sorted into its tile's list.
struct Pair {
  uint32_t gaussian, tile;
};

// A part of the depth order that one thread bins.
struct BinChunk {
  int64_t first, last;  // ranks in depth order
  Buffer<Pair> pairs;
  Buffer<int32_t> counts;  // per tile; then where the chunk's next entry of that tile goes
};

constexpr int kMostDigitBits = 12;  // in one pass of the radix sort

// A part of the Gaussians that one thread sorts.
struct SortPart {
  uint32_t counts[1 << kMostDigitBits];  // per digit; then where the next with that digit goes
};

struct Frame {
  bool differentiable = true;  // without it, there can be no backward pass
  Buffer<Splat> splats;
  Buffer<TileSpan> spans;
  Buffer<uint32_t> depth_keys, sorted_keys, order, scratch_keys, scratch_order;
  Buffer<DepthRange> depth_ranges;  // per group of Gaussians
  Buffer<uint32_t> slot_counts;     // per Gaussian
  Buffer<uint32_t> slot_totals;     // per thread
  Buffer<uint32_t> slot_begins;     // [n + 1]
  Buffer<Entry> entries;
  Buffer<uint64_t> masks;
  Buffer<int32_t> tile_begins, tile_ends;
  Buffer<int32_t> run_begins;  // [runs + 1]: tiles that one thread works on, one after the other
  Buffer<Moments> slots;
  Buffer<float> view_gradients;  // per group of Gaussians
  Buffer<SortPart> sort_parts;
  std::deque<BinChunk> chunks;
  int64_t drawn = 0, pairs = 0;
  int columns = 0, rows = 0, runs = 0;
  std::mutex backward;  // `slots` and `view_gradients` are one backward pass's

  TileLists lists() {
    uint64_t* const kept = differentiable ? masks.data() : nullptr;
    return {entries.data(), kept, tile_begins.data(), tile_ends.data(), columns, rows};
  }
};

// Fills frame.order with the drawn Gaussians, nearest first; equal depths stay in the order of their indices. Reads
// frame.depth_keys and frame.depth_ranges.
void sort_by_depth(Frame& frame, int64_t count);

// Fills the tiles' lists and runs, and the Gaussians' slots; reads frame.slot_counts and completes it. The result does
// not depend on the number of threads. Throws std::length_error where there are more than kMostPairs pairs.
void bin_into_tiles(Frame& frame, int64_t count);

}  // namespace mien
