// The pool: every index once, whoever asks, however loops are nested, side by side or short; and what fails in them.
#include <atomic>
#include <new>
#include <stdexcept>
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

template <typename Error, typename Body>
bool throws(Body&& body) {
  try {
    body();
  } catch (const Error&) {
    return true;
  }
  return false;
}

// An exception reaches the caller from whichever thread it is thrown on, and the pool goes on.
void check_exceptions() {
  for (int64_t bad : {0, 1, 499, 500, 999}) {
    CHECK(throws<std::bad_alloc>([&] {
      mien::parallel_for(1000, [&](int64_t index) {
        if (index == bad) throw std::bad_alloc();
      });
    }));
    check_each_index_once(1000);
  }
  CHECK(throws<std::length_error>(
      [] { mien::parallel_for(1000, [](int64_t) { throw std::length_error("on every thread"); }); }));
  CHECK(throws<std::length_error>([] {
    mien::parallel_for(12, [](int64_t outer) {
      mien::parallel_for(34, [&](int64_t inner) {
        if (outer == 7 && inner == 30) throw std::length_error("in a nested loop");
      });
    });
  }));
  check_nested_loops();
}

// A loop that fails stops soon: most of its indices are never begun.
void check_that_failure_ends_the_loop() {
  std::atomic<int64_t> begun{0};
  CHECK(throws<std::bad_alloc>([&] {
    mien::parallel_for(1'000'000, [&](int64_t) {
      if (++begun > 100) throw std::bad_alloc();
    });
  }));
  CHECK(begun < 1000);
}

void check_thread_counts() {
  const int before = mien::thread_count();
  for (int count : {-1, INT32_MIN, mien::kMostThreads + 1, INT32_MAX})
    CHECK(throws<std::invalid_argument>([&] { mien::set_thread_count(count); }));
  CHECK(mien::thread_count() == before);
}

// The pool is replaced while others run loops on it.
void check_replacing_the_pool() {
  std::atomic<bool> done{false};
  std::vector<std::thread> callers;
  for (int caller = 0; caller < 3; ++caller) {
    callers.emplace_back([&] {
      while (!done) check_each_index_once(100);
    });
  }
  for (int repeat = 0; repeat < 30; ++repeat) mien::set_thread_count(1 + repeat % 4);
  done = true;
  for (auto& caller : callers) caller.join();
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
    check_exceptions();
    check_that_failure_ends_the_loop();
    // Longer than workers spin: they park, and have to be woken.
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
    check_each_index_once(1000);
  }
  check_thread_counts();
  check_replacing_the_pool();
}

}  // namespace checks
