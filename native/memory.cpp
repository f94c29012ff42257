#include "memory.h"

#include <deque>
#include <mutex>
#ifdef __GLIBC__
#include <malloc.h>
#endif

namespace mien {
namespace {

constexpr size_t kMostBytes = size_t{256} << 20;  // most unused memory that is kept
constexpr size_t kLeastBytes = size_t{1} << 20;   // smaller blocks come back from the allocator without fresh pages

struct Block {
  void* memory;
  size_t bytes;
};

// Unused blocks, the most recent last. Never destroyed: arrays may outlive static destructors.
struct Spare {
  std::mutex mutex;
  std::deque<Block> blocks;
  size_t bytes = 0;
};
Spare& spare() {
  static auto* one = new Spare;
  return *one;
}

}  // namespace

void* take_memory(size_t bytes) {
  if (bytes >= kLeastBytes) {
    Spare& kept = spare();
    const std::lock_guard<std::mutex> lock(kept.mutex);
    for (auto block = kept.blocks.rbegin(); block != kept.blocks.rend(); ++block) {
      if (block->bytes != bytes) continue;
      void* const memory = block->memory;
      kept.blocks.erase(std::next(block).base());
      kept.bytes -= bytes;
      return memory;
    }
  }
  return allocate_aligned(bytes < 64 ? 64 : (bytes + 63) / 64 * 64);
}

void give_memory(void* memory, size_t bytes) noexcept {
  if (bytes < kLeastBytes) return free_aligned(memory);
  Spare& kept = spare();
  const std::lock_guard<std::mutex> lock(kept.mutex);
  try {
    kept.blocks.push_back({memory, bytes});
  } catch (const std::bad_alloc&) {
    free_aligned(memory);
    return;
  }
  kept.bytes += bytes;
  while (kept.bytes > kMostBytes) {
    free_aligned(kept.blocks.front().memory);
    kept.bytes -= kept.blocks.front().bytes;
    kept.blocks.pop_front();
  }
}

void release_memory() noexcept {
  Spare& kept = spare();
  const std::lock_guard<std::mutex> lock(kept.mutex);
  for (const Block& block : kept.blocks) free_aligned(block.memory);
  kept.blocks.clear();
  kept.bytes = 0;
#ifdef __GLIBC__
  malloc_trim(0);
#endif
}

}  // namespace mien
