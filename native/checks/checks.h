// What the checks share: exact-size random arrays (so that AddressSanitizer sees every overrun), and complaints.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

namespace checks {

using Floats = std::vector<float>;

inline void fail(const char* what, const char* file, int line) {
  std::fprintf(stderr, "%s:%d: %s\n", file, line, what);
  std::exit(1);
}
#define CHECK(condition) \
  if (!(condition)) checks::fail(#condition, __FILE__, __LINE__)

class Random {
 public:
  explicit Random(uint32_t seed) : engine_(seed) {}
  Floats normal(int64_t count, float scale = 1) {
    std::normal_distribution<float> distribution(0, scale);
    Floats values(count);
    for (float& value : values) value = distribution(engine_);
    return values;
  }
  Floats uniform(int64_t count, float low = 0, float high = 1) {
    std::uniform_real_distribution<float> distribution(low, high);
    Floats values(count);
    for (float& value : values) value = distribution(engine_);
    return values;
  }
  int64_t below(int64_t limit) { return std::uniform_int_distribution<int64_t>(0, limit - 1)(engine_); }

 private:
  std::mt19937 engine_;
};

inline bool all_finite(const Floats& values) {
  for (float value : values) {
    if (!std::isfinite(value)) return false;
  }
  return true;
}

void check_pool();
void check_rasterizer();
void check_training_step();
void check_face();
void check_feature_network();
void check_mesh();

}  // namespace checks
