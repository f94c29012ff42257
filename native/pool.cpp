#include "pool.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <mutex>
#include <thread>
#include <vector>

namespace mien {
namespace {

// Waking a parked thread costs about 50 us, so waiting threads spin at first: the longer the more often that was of
// use. Where others want the cores, spinning in vain would only take them away.
constexpr std::chrono::microseconds kLeastSpin{5}, kMostSpin{100};

void relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#else
  std::this_thread::yield();
#endif
}

// Waits until `done()`, spinning for `spin`, which follows what came of it; false if it was not done by then.
template <typename Done>
bool spin_until(Done&& done, std::chrono::microseconds& spin) {
  const auto end = std::chrono::steady_clock::now() + spin;
  while (std::chrono::steady_clock::now() < end) {
    for (int i = 0; i < 32; ++i) {
      if (done()) {
        spin = std::min(2 * spin, kMostSpin);
        return true;
      }
      relax();
    }
  }
  spin = std::max(spin / 2, kLeastSpin);
  return done();
}

// Whether this thread runs a loop's body: loops within it are serial.
thread_local bool t_in_loop = false;

class Pool {
 public:
  explicit Pool(int threads) : shares_(threads) {
    for (int i = 1; i < threads; ++i) workers_.emplace_back([this, i] { serve(i); });
  }

  ~Pool() {
    stop_ = true;
    announce();
    for (auto& worker : workers_) worker.join();
  }

  int threads() const { return static_cast<int>(shares_.size()); }

  void run(int64_t count, detail::LoopBody body, void* context) {
    std::unique_lock<std::mutex> lock;
    if (!t_in_loop && !workers_.empty()) lock = std::unique_lock(busy_, std::try_to_lock);
    if (!lock.owns_lock()) {
      for (int64_t index = 0; index < count; ++index) body(context, index);
      return;
    }
    body_ = body;
    context_ = context;
    for (int i = 0; i < threads(); ++i) {
      shares_[i].next.store(count * i / threads(), std::memory_order_relaxed);
      shares_[i].end = count * (i + 1) / threads();
    }
    state_.store(kOpen, std::memory_order_release);
    announce();
    t_in_loop = true;
    work(0);
    t_in_loop = false;
    // From here on no worker enters; wait for those inside.
    state_.fetch_and(~kOpen, std::memory_order_acq_rel);
    const auto left = [this] { return state_.load(std::memory_order_acquire) == 0; };
    if (spin_until(left, spin_)) return;
    for (uint32_t inside; (inside = state_.load(std::memory_order_acquire)) != 0;) {
      state_.wait(inside, std::memory_order_acquire);
    }
  }

 private:
  static constexpr uint32_t kOpen = 1u << 31;  // the other bits of state_ count the workers inside the loop

  void announce() {
    signal_.fetch_add(1, std::memory_order_release);
    signal_.notify_all();
  }

  // One's own share, then what is left of the others'.
  void work(int self) {
    for (int i = 0; i < threads(); ++i) {
      Share& share = shares_[(self + i) % threads()];
      for (int64_t index; (index = share.next.fetch_add(1, std::memory_order_relaxed)) < share.end;) {
        body_(context_, index);
      }
    }
  }

  bool enter() {
    uint32_t state = state_.load(std::memory_order_acquire);
    while (state & kOpen) {
      if (state_.compare_exchange_weak(state, state + 1, std::memory_order_acq_rel)) return true;
    }
    return false;
  }

  void serve(int self) {
    t_in_loop = true;
    uint32_t seen = 0;
    std::chrono::microseconds spin = kMostSpin;
    while (!stop_) {
      const auto announced = [this, seen] { return signal_.load(std::memory_order_acquire) != seen; };
      if (!spin_until(announced, spin)) signal_.wait(seen, std::memory_order_acquire);
      seen = signal_.load(std::memory_order_acquire);
      if (stop_) return;
      if (enter()) {
        work(self);
        if (state_.fetch_sub(1, std::memory_order_acq_rel) == 1) state_.notify_one();
      }
    }
  }

  // A part of the loop's indices. Each thread has the same one in every loop of that length, so that what it wrote last
  // time is in its own caches: between cores that share none, fetching it takes longer than most of what is done with
  // it.
  struct alignas(64) Share {
    std::atomic<int64_t> next{0};
    int64_t end = 0;
  };

  std::vector<Share> shares_;
  std::vector<std::thread> workers_;
  std::mutex busy_;
  std::chrono::microseconds spin_ = kMostSpin;  // of whoever runs a loop
  detail::LoopBody body_ = nullptr;
  void* context_ = nullptr;
  alignas(64) std::atomic<uint32_t> state_{0};
  alignas(64) std::atomic<uint32_t> signal_{0};
  std::atomic<bool> stop_{false};
};

// Never destroyed: the threads end with the process. A forked child has no workers, so it forgets its parent's pool.
std::atomic<Pool*> g_pool{nullptr};
std::mutex* g_creation = new std::mutex;

void forget_pool() {
  g_pool = nullptr;
  g_creation = new std::mutex;
}

int default_threads() {
  const char* text = std::getenv("MIEN_THREADS");
  const int wanted = text ? std::atoi(text) : 0;
  return wanted > 0 ? wanted : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

Pool& pool() {
  if (Pool* existing = g_pool.load(std::memory_order_acquire)) return *existing;
  const std::lock_guard<std::mutex> lock(*g_creation);
  if (!g_pool) {
    static const int registered = pthread_atfork(nullptr, nullptr, forget_pool);
    static_cast<void>(registered);
    g_pool = new Pool(default_threads());
  }
  return *g_pool;
}

}  // namespace

int thread_count() { return pool().threads(); }

void set_thread_count(int count) {
  pool();
  const std::lock_guard<std::mutex> lock(*g_creation);
  delete g_pool.exchange(new Pool(count > 0 ? count : default_threads()));
}

void detail::run_loop(int64_t count, LoopBody body, void* context) {
  if (count <= 1) {
    if (count == 1) body(context, 0);
    return;
  }
  pool().run(count, body, context);
}

}  // namespace mien
