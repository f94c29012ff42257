#include "composite.h"

#include <cstring>

namespace mien {
namespace {

constexpr int kPixels = 8;  // whose mattes are compared at once: mostly, all are 0 or all are 255

// The rounded quotient by 255, exact for 0 .. 255 * 255.
uint8_t divided(unsigned value) {
  value += 128;
  return static_cast<uint8_t>((value + (value >> 8)) >> 8);
}

void blend(const uint8_t* image, const uint8_t* matte, const uint8_t* background, int count, uint8_t* out) {
  for (int x = 0; x < count; ++x) {
    const unsigned alpha = matte[x];
    for (int c = 0; c < 3; ++c) {
      out[3 * x + c] = divided(image[3 * x + c] * alpha + background[c] * (255 - alpha));
    }
  }
}

}  // namespace

void composite(const CompositeTask& task) {
  uint8_t plain[3 * kPixels];
  for (int i = 0; i < 3 * kPixels; ++i) plain[i] = task.background[i % 3];
  const auto fill = [&](uint8_t* out, int count) {
    for (; count >= kPixels; count -= kPixels, out += sizeof plain) std::memcpy(out, plain, sizeof plain);
    std::memcpy(out, plain, 3 * static_cast<size_t>(count));
  };
  const PixelBox& box = task.box;
  for (int y = 0; y < task.height; ++y) {
    const int64_t row = static_cast<int64_t>(y) * task.width;
    uint8_t* const out = task.picture + 3 * row;
    if (y < box.top || y >= box.bottom) {
      fill(out, task.width);
      continue;
    }
    fill(out, box.left);
    int x = box.left;
    for (; x + kPixels <= box.right; x += kPixels) {
      uint64_t mattes;
      std::memcpy(&mattes, task.matte + row + x, sizeof mattes);
      if (mattes == 0) {
        std::memcpy(out + 3 * x, plain, sizeof plain);
      } else if (mattes == ~uint64_t{0}) {
        std::memcpy(out + 3 * x, task.image + 3 * (row + x), sizeof plain);
      } else {
        blend(task.image + 3 * (row + x), task.matte + row + x, task.background, kPixels, out + 3 * x);
      }
    }
    blend(task.image + 3 * (row + x), task.matte + row + x, task.background, box.right - x, out + 3 * x);
    fill(out + 3 * box.right, task.width - box.right);
  }
}

}  // namespace mien
