#include "photometric.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "isa.h"
#include "photometric_kernels.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(PhotometricKernels, photometric_kernels)

namespace {

constexpr int kRowsAtATime = 64;  // rows of bytes that one piece of the pool's work converts to floats
constexpr int kTaps = 2 * kPhotometricRadius + 1;

struct Window {
  float weights[kTaps];

  Window() {
    double exact[kTaps], sum = 0;
    for (int i = 0; i < kTaps; ++i) {
      const double distance = i - kPhotometricRadius;
      sum += exact[i] = std::exp(-distance * distance / (2 * 1.5 * 1.5));
    }
    for (int i = 0; i < kTaps; ++i) weights[i] = static_cast<float>(exact[i] / sum);
  }
};

// Kept between calls: fresh pages cost as much as the work.
struct Workspace {
  std::vector<float> target;
  std::vector<double> sums;
};

void set_row_buffers(PhotometricBand& band) {
  thread_local std::vector<float> storage;
  const size_t columns = static_cast<size_t>(band.limit - band.origin);
  const size_t row = (columns + kPhotometricLine - 1) / kPhotometricLine * kPhotometricLine + 2 * kPhotometricPad;
  storage.assign(row * (7 * kPhotometricRows + 3 * kPhotometricRing + 1) + kPhotometricLine, 0.0f);
  const size_t beyond = reinterpret_cast<uintptr_t>(storage.data()) / sizeof(float) % kPhotometricLine;
  float* next = storage.data() + (kPhotometricLine - beyond) % kPhotometricLine + kPhotometricPad;
  const auto take = [&](float*& buffer) { buffer = next, next += row; };
  take(band.zeros);
  for (auto& map : band.blurred) {
    for (float*& buffer : map) take(buffer);
  }
  for (auto& map : band.derivatives) {
    for (float*& buffer : map) take(buffer);
  }
  for (auto& map : band.ring) {
    for (float*& buffer : map) take(buffer);
  }
}

// Part `index` of `parts` of the gradient's rows above and below first_row .. last_row - 1.
void clear_beyond(const PhotometricTask& task, int first_row, int last_row, int64_t index, int parts) {
  if (!task.gradient) return;
  const int rows = first_row + task.height - last_row;
  for (int64_t i = rows * index / parts; i < rows * (index + 1) / parts; ++i) {
    const int64_t row = i < first_row ? i : i - first_row + last_row, stride = task.width * kPhotometricChannels;
    std::memset(task.gradient + row * stride, 0, sizeof(float) * static_cast<size_t>(stride));
  }
}

// The fields that all bands share.
PhotometricBand whole_band(const PhotometricTask& task, Workspace& work) {
  static const Window window;
  const int stride = task.width * kPhotometricChannels;
  const double count = static_cast<double>(stride) * task.height;
  work.sums.assign(2 * static_cast<size_t>(task.height), 0.0);
  PhotometricBand whole{};
  whole.image = task.image;
  whole.target = task.target;
  whole.gradient = task.gradient;
  whole.stride = stride;
  whole.height = task.height;
  whole.top = task.box.top;
  whole.bottom = task.box.bottom;
  whole.left = task.box.left * kPhotometricChannels;
  whole.right = task.box.right * kPhotometricChannels;
  whole.origin = std::max(whole.left - kPhotometricReach, 0) / kPhotometricLine * kPhotometricLine;
  whole.limit = std::min(whole.right + kPhotometricReach, stride);
  whole.l1_factor = static_cast<float>(task.l1_weight / count);
  whole.ssim_factor = static_cast<float>(task.ssim_weight / count);
  whole.weights = window.weights;
  whole.l1_sums = work.sums.data();
  whole.ssim_sums = work.sums.data() + task.height;
  return whole;
}

// A target of bytes as floats, as far as windows around first_row .. last_row - 1 reach.
const float* target_as_floats(const PhotometricTask& task, const PhotometricBand& whole, int first_row, int last_row,
                              Workspace& work) {
  const PhotometricKernels& kernels = photometric_kernels();
  work.target.resize(static_cast<size_t>(whole.stride) * task.height);
  float* const floats = work.target.data();
  const int begin = std::max(first_row - kPhotometricRadius, 0);
  const int rows = std::min(last_row + kPhotometricRadius, task.height) - begin;
  parallel_for((rows + kRowsAtATime - 1) / kRowsAtATime, [&](int64_t piece) {
    const int last = std::min(rows, static_cast<int>(piece + 1) * kRowsAtATime);
    for (int row = static_cast<int>(piece) * kRowsAtATime; row < last; ++row) {
      const int64_t from = static_cast<int64_t>(begin + row) * whole.stride + whole.origin;
      kernels.bytes_to_floats(task.target_bytes + from, whole.limit - whole.origin, floats + from);
    }
  });
  return floats;
}

}  // namespace

double photometric_loss(const PhotometricTask& task) {
  const PhotometricKernels& kernels = photometric_kernels();
  thread_local Workspace work;
  const int first_row = std::max(task.box.top - kPhotometricRadius, 0);
  const int last_row = std::min(task.box.bottom + kPhotometricRadius, task.height);
  PhotometricBand whole = whole_band(task, work);
  if (!task.target) whole.target = target_as_floats(task, whole, first_row, last_row, work);

  // Every row's numbers are the same in any division into bands, so there are as many bands as threads.
  const int rows = last_row - first_row;
  const int bands = std::clamp(rows / (2 * kTaps), 1, thread_count());
  parallel_for(bands, [&](int64_t index) {
    PhotometricBand band = whole;
    band.begin = first_row + static_cast<int>(rows * index / bands);
    band.end = first_row + static_cast<int>(rows * (index + 1) / bands);
    set_row_buffers(band);
    kernels.band(band);
    clear_beyond(task, first_row, last_row, index, bands);
  });

  double l1 = 0, ssim = 0;
  for (int y = task.box.top; y < task.box.bottom; ++y) {
    l1 += whole.l1_sums[y];
    ssim += whole.ssim_sums[y];
  }
  const double count = static_cast<double>(whole.stride) * task.height;
  const double inside = static_cast<double>(whole.right - whole.left) * (task.box.bottom - task.box.top);
  return task.l1_weight * l1 / count + task.ssim_weight * (inside - ssim) / count;
}

}  // namespace mien
