// Memory for large results, which is reused: the kernel clears fresh pages, and that takes longer than drawing on them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <new>
#include <utility>

namespace mien {

// Memory aligned to a cache line, from the operator new of C++, since Windows has no std::aligned_alloc. Null if there
// is none. `free_aligned` frees it.
inline void* allocate_aligned(size_t bytes) { return ::operator new(bytes, std::align_val_t{64}, std::nothrow); }
inline void free_aligned(void* memory) noexcept { ::operator delete(memory, std::align_val_t{64}); }

// At least `bytes` of undefined values, aligned to a cache line; null if there is no memory.
void* take_memory(size_t bytes);
// Keeps memory for the next `take_memory` of the same size, or frees it. `bytes` is the number it was taken with.
void give_memory(void* memory, size_t bytes) noexcept;
// Frees what is kept, and gives what the allocator holds free back to the system.
void release_memory() noexcept;

// Memory for `count` values that goes back at the end of its life. Throws std::bad_alloc.
template <typename T>
class Recycled {
 public:
  explicit Recycled(size_t count) : bytes_(count * sizeof(T)) {
    if (count > SIZE_MAX / 2 / sizeof(T) || !(data_ = static_cast<T*>(take_memory(bytes_)))) throw std::bad_alloc();
  }
  Recycled(Recycled&& other) noexcept : bytes_(other.bytes_), data_(std::exchange(other.data_, nullptr)) {}
  ~Recycled() {
    if (data_) give_memory(data_, bytes_);
  }
  T* data() const { return data_; }
  size_t size() const { return bytes_ / sizeof(T); }

 private:
  size_t bytes_;
  T* data_ = nullptr;
};

}  // namespace mien
