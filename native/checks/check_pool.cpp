// The pool: every index once, whoever asks, however loops are nested, side by side or short.
#include <atomic>
#include <thread>

#include "checks.h"
#include "pool.h"

namespace checks {
namespace {

void check_each_index_once(int64_t count) {
  std::vector<int> seen(count, 0);
  mien::parallel_for(count, [&](int64_t index) { ++seen[index]; });
  for (int times : seen) CHECK(times == 1);
}

void check_nested_loops() {
  std::vector<int> seen(12 * 34, 0);
  mien::parallel_for(
      12, [&](int64_t outer) { mien::parallel_for(34, [&](int64_t inner) { ++seen[outer * 34 + inner]; }); });
  for (int times : seen) CHECK(times == 1);
}

void check_loops_side_by_side() {
  std::vector<std::thread> callers;
  std::atomic<int64_t> total{0};
  for (int caller = 0; caller < 4; ++caller) {
    callers.emplace_back([&] {
      for (int repeat = 0; repeat < 50; ++repeat) {
        std::vector<int64_t> squares(64);
        mien::parallel_for(64, [&](int64_t index) { squares[index] = index * index; });
        for (int64_t value : squares) total += value;
      }
    });
  }
  for (auto& caller : callers) caller.join();
  CHECK(total == 4 * 50 * (63 * 64 * 127 / 6));
}

}  // namespace

void check_pool() {
  for (int threads : {1, 2, 3, 8, 2}) {
    mien::set_thread_count(threads);
    CHECK(mien::thread_count() == threads);
    for (int64_t count : {0, 1, 2, 3, 100, 5000}) check_each_index_once(count);
    for (int repeat = 0; repeat < 200; ++repeat) check_each_index_once(3);  // workers come and go within microseconds
    check_nested_loops();
    check_loops_side_by_side();
    // Longer than workers spin: they park, and have to be woken.
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
    check_each_index_once(1000);
  }
}

}  // namespace checks
