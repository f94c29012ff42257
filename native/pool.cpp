#include "pool.h"

#if !defined(_WIN32)
#include <pthread.h>
#endif

#include <algorithm>
#include <atomic>
#include <charconv>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

namespace mien {
namespace {

// Waking a parked thread costs about 50 us, so waiting threads spin at first. They spin longer if that has helped
// before: if other processes want the cores, spinning in vain only takes cores away.
constexpr std::chrono::microseconds kLeastSpin{5}, kMostSpin{100};

void relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#else
  std::this_thread::yield();
#endif
}

// Spins for at most `spin` until `done()`, and adapts `spin` to the outcome. Returns false if it was not done in time.
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

// Whether this thread runs the body of a loop. Loops inside that body are serial.
thread_local bool t_in_loop = false;

class Pool {
 public:
  // Has fewer threads than requested if the system starts no more.
  explicit Pool(int threads) : shares_(threads) {
    workers_.reserve(threads - 1);
    try {
      for (int i = 1; i < threads; ++i) workers_.emplace_back([this, i] { serve(i); });
    } catch (const std::system_error&) {  // a limit of processes or of address space
    } catch (const std::bad_alloc&) {
    }
    threads_ = static_cast<int>(workers_.size()) + 1;  // workers read it within loops only, which come later
    // A thread without memory for its own variables ends the process. Now there is more memory than within a loop.
    for (int now; (now = started_.load(std::memory_order_acquire)) < threads_ - 1;) started_.wait(now);
  }

  // Ends the workers after the loop that is running. Callers that still hold this pool run loops on their own thread.
  void retire() {
    const std::lock_guard<std::mutex> lock(busy_);
    stop_ = true;
    announce();
    for (auto& worker : workers_) worker.join();
  }

  int threads() const { return threads_; }

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
    // No worker enters from here on. Wait for those inside.
    state_.fetch_and(~kOpen, std::memory_order_acq_rel);
    const auto left = [this] { return state_.load(std::memory_order_acquire) == 0; };
    if (!spin_until(left, spin_)) {
      for (uint32_t inside; (inside = state_.load(std::memory_order_acquire)) != 0;) {
        state_.wait(inside, std::memory_order_acquire);
      }
    }
    if (error_) std::rethrow_exception(std::exchange(error_, nullptr));
  }

 private:
  static constexpr uint32_t kOpen = 1u << 31;  // the other bits of state_ count the workers inside the loop

  void announce() {
    signal_.fetch_add(1, std::memory_order_release);
    signal_.notify_all();
  }

  // Runs the own share, then what is left of the others'. An exception that leaves a worker would end the process.
  void work(int self) noexcept {
    try {
      for (int i = 0; i < threads(); ++i) {
        Share& share = shares_[(self + i) % threads()];
        for (int64_t index; (index = share.next.fetch_add(1, std::memory_order_relaxed)) < share.end;) {
          body_(context_, index);
        }
      }
    } catch (...) {
      for (Share& share : shares_)
        share.next.store(share.end, std::memory_order_relaxed);  // no thread starts another index
      const std::lock_guard<std::mutex> lock(error_mutex_);
      if (!error_) error_ = std::current_exception();
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
    started_.fetch_add(1, std::memory_order_release);
    started_.notify_one();
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

  // A part of the loop's indices. A thread has the same part in every loop of that length, so its data is in its own
  // caches. Fetching data from a core without a shared cache takes longer than most of the work on it.
  struct alignas(64) Share {
    std::atomic<int64_t> next{0};
    int64_t end = 0;
  };

  std::vector<Share> shares_;
  std::vector<std::thread> workers_;
  int threads_ = 1;
  std::atomic<int> started_{0};
  std::mutex busy_, error_mutex_;
  std::exception_ptr error_;                    // the first exception of a loop
  std::chrono::microseconds spin_ = kMostSpin;  // for the thread that runs a loop
  detail::LoopBody body_ = nullptr;
  void* context_ = nullptr;
  alignas(64) std::atomic<uint32_t> state_{0};
  alignas(64) std::atomic<uint32_t> signal_{0};
  std::atomic<bool> stop_{false};
};

// Never destroyed: the threads end with the process. A forked child has no workers, so it forgets its parent's pool.
std::atomic<Pool*> g_pool{nullptr};
std::mutex* g_creation = new std::mutex;
// Pools that were replaced. They stay, since another thread may be about to run a loop on one.
std::vector<Pool*>* g_retired = new std::vector<Pool*>;

#if defined(_WIN32)
void forget_in_children() {}  // Windows has no fork
#else
void forget_pool() {
  g_pool = nullptr;
  g_creation = new std::mutex;
}

void forget_in_children() {
  static const int registered = pthread_atfork(nullptr, nullptr, forget_pool);
  static_cast<void>(registered);
}
#endif

int checked_threads(const char* what, long long count) {
  if (count < 0 || count > kMostThreads) {
    throw std::invalid_argument(std::string(what) + " is " + std::to_string(count) + "; give a number from 1 to " +
                                std::to_string(kMostThreads) + ", or 0 for one thread a core");
  }
  const int cores = std::clamp(static_cast<int>(std::thread::hardware_concurrency()), 1, kMostThreads);
  return count > 0 ? static_cast<int>(count) : cores;
}

int default_threads() {
  const char* text = std::getenv("MIEN_THREADS");
  if (!text || !*text) return checked_threads("MIEN_THREADS", 0);
  long long count = 0;
  const char* const end = text + std::strlen(text);
  const auto [stop, error] = std::from_chars(text, end, count);
  if (error != std::errc() || stop != end) {
    throw std::invalid_argument("MIEN_THREADS is '" + std::string(text) + "'; give a number from 1 to " +
                                std::to_string(kMostThreads) + ", or 0 for one thread a core");
  }
  return checked_threads("MIEN_THREADS", count);
}

Pool& pool() {
  if (Pool* existing = g_pool.load(std::memory_order_acquire)) return *existing;
  const std::lock_guard<std::mutex> lock(*g_creation);
  if (!g_pool) {
    forget_in_children();
    g_pool = new Pool(default_threads());
  }
  return *g_pool;
}

}  // namespace

int thread_count() { return pool().threads(); }

void set_thread_count(int count) {
  const int threads = count == 0 ? default_threads() : checked_threads("the number of threads", count);
  const std::lock_guard<std::mutex> lock(*g_creation);
  forget_in_children();
  g_retired->reserve(g_retired->size() + 1);
  Pool* const before = g_pool.exchange(new Pool(threads));
  if (!before) return;
  before->retire();
  g_retired->push_back(before);
}

void detail::run_loop(int64_t count, LoopBody body, void* context) {
  if (count <= 1) {
    if (count == 1) body(context, 0);
    return;
  }
  pool().run(count, body, context);
}

void keep_loops_serial(bool serial) { t_in_loop = serial; }

}  // namespace mien
