// A persistent pool for parallel loops of about a millisecond: its workers spin briefly after each loop, then park.
#pragma once

#include <cstdint>

namespace mien {

constexpr int kMostThreads = 1024;  // more threads would only wait for each other

// Number of threads that parallel loops use: MIEN_THREADS, by default the number of cores, or fewer if the system
// starts no more. Throws std::invalid_argument if MIEN_THREADS is not a number from 0 (the default) to kMostThreads.
int thread_count();
// Replaces the pool; 0 goes back to the default. Throws std::invalid_argument for numbers outside 0..kMostThreads.
// Waits for a loop that is running, so it must not be called from within one.
void set_thread_count(int count);

// Makes all loops of the calling thread serial, or not. For threads that share the cores between them.
void keep_loops_serial(bool serial);

namespace detail {
using LoopBody = void (*)(void* context, int64_t index);
void run_loop(int64_t count, LoopBody body, void* context);
}  // namespace detail

// Calls body(index) for 0 <= index < count, in any order, from several threads. The loop is serial if there is one
// thread or one index, or if the pool is busy with another thread's loop; so loops may be nested or run side by side.
// Results must not depend on which thread runs which index. If a body throws, no further index starts, and the first
// exception reaches the caller.
template <typename Body>
void parallel_for(int64_t count, Body&& body) {
  detail::run_loop(count, [](void* context, int64_t index) { (*static_cast<Body*>(context))(index); }, &body);
}

}  // namespace mien
