// A persistent pool for parallel loops of about a millisecond: its workers spin briefly after each loop, then park.
#pragma once

#include <cstdint>

namespace mien {

constexpr int kMostThreads = 1024;  // more would only wait for each other

// Number of threads that parallel loops use: MIEN_THREADS, by default the number of cores. Fewer where the system
// starts no more. Throws std::invalid_argument where MIEN_THREADS is no number from 0 to kMostThreads (0: the default).
int thread_count();
// Replaces the pool; 0 goes back to the default, other numbers than 0..kMostThreads throw std::invalid_argument. Waits
// for a loop that is running; not to be called from within one.
void set_thread_count(int count);

namespace detail {
using LoopBody = void (*)(void* context, int64_t index);
void run_loop(int64_t count, LoopBody body, void* context);
}  // namespace detail

// Calls body(index) for 0 <= index < count, in any order, from several threads. Serial where there is one thread, one
// index, or the pool is busy with another thread's loop (so loops may be nested or run side by side).
// Results must not depend on who runs which index. Where a body throws, no further indices are begun, and the first
// exception reaches the caller.
template <typename Body>
void parallel_for(int64_t count, Body&& body) {
  detail::run_loop(count, [](void* context, int64_t index) { (*static_cast<Body*>(context))(index); }, &body);
}

}  // namespace mien
