// A persistent pool for parallel loops of about a millisecond: its workers spin briefly after each loop, then park.
#pragma once

#include <cstdint>

namespace mien {

// Number of threads that parallel loops use: MIEN_THREADS, by default the number of cores.
int thread_count();
// Replaces the pool; 0 goes back to the default. Not to be called from within a loop.
void set_thread_count(int count);

namespace detail {
using LoopBody = void (*)(void* context, int64_t index);
void run_loop(int64_t count, LoopBody body, void* context);
}  // namespace detail

// Calls body(index) for 0 <= index < count, in any order, from several threads. Serial where there is one thread, one
// index, or the pool is busy with another thread's loop (so loops may be nested or run side by side).
// The body must not throw, and results must not depend on who runs which index.
template <typename Body>
void parallel_for(int64_t count, Body&& body) {
  detail::run_loop(count, [](void* context, int64_t index) { (*static_cast<Body*>(context))(index); }, &body);
}

}  // namespace mien
