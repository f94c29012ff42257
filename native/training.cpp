#include "training.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "isa.h"
#include "pool.h"
#include "training_kernels.h"

namespace mien {

MIEN_CHOOSE_KERNELS(TrainingKernels, training_kernels)

namespace {

constexpr int64_t kElements = 16384, kGaussians = 4096;  // in one piece of the pool's work

struct Piece {
  int task;
  int64_t first, last;
};

// The same for rows top .. bottom - 1; all 0 if they hold only zeros.
PixelBox box_of_rows(const float* values, int width, int top, int bottom) {
  const auto any_nonzero = training_kernels().any_nonzero;
  const auto row = [&](int y) { return values + static_cast<int64_t>(y) * width; };
  while (top < bottom && !any_nonzero(row(top), width)) ++top;
  if (top == bottom) return {0, 0, 0, 0};
  while (!any_nonzero(row(bottom - 1), width)) --bottom;
  int left = width, right = 0;
  for (int y = top; y < bottom; ++y) {
    const float* from = row(y);
    for (int x = 0; x < left; ++x) {
      if (from[x] != 0) left = x;
    }
    for (int x = width; x > right; --x) {
      if (from[x - 1] != 0) right = x;
    }
  }
  return {left, top, right, bottom};
}

// Calls work(task, first, last) for pieces of the elements of all tasks, on all threads.
template <typename Task, typename Work>
void in_pieces(const Task* tasks, int count, const Work& work) {
  thread_local std::vector<Piece> pieces;
  pieces.clear();
  for (int task = 0; task < count; ++task) {
    for (int64_t first = 0; first < tasks[task].count; first += kElements) {
      pieces.push_back({task, first, std::min(first + kElements, tasks[task].count)});
    }
  }
  const Piece* all = pieces.data();
  parallel_for(static_cast<int64_t>(pieces.size()),
               [&](int64_t index) { work(tasks[all[index].task], all[index].first, all[index].last); });
}

}  // namespace

void adam_update(const AdamTask* tasks, int count) {
  const TrainingKernels& kernels = training_kernels();
  in_pieces(tasks, count, [&](const AdamTask& task, int64_t first, int64_t last) { kernels.adam(task, first, last); });
}

void add_arrays(const SumTask* tasks, int count) {
  in_pieces(tasks, count, [](const SumTask& task, int64_t first, int64_t last) {
    for (int64_t i = first; i < last; ++i) task.sum[i] = task.first[i] + task.second[i];
  });
}

void factored_adam_update(const FactoredAdamTask& task) {
  constexpr int64_t kRows = 64;  // Gaussians in a piece, each with all its columns
  const TrainingKernels& kernels = training_kernels();
  parallel_for((task.count + kRows - 1) / kRows, [&](int64_t piece) {
    kernels.factored_adam(task, piece * kRows, std::min((piece + 1) * kRows, task.count));
  });
}

Penalties triangle_penalties(const PenaltyTask& task) {
  const int64_t in_view = std::count_if(task.radii, task.radii + task.count, [](int32_t radius) { return radius > 0; });
  const float share = 1.0f / static_cast<float>(std::max<int64_t>(in_view, 1));
  const int64_t pieces = (task.count + kGaussians - 1) / kGaussians;
  thread_local std::vector<Penalties> sums;
  sums.resize(pieces);
  Penalties* const parts = sums.data();
  const TrainingKernels& kernels = training_kernels();
  parallel_for(pieces, [&](int64_t index) {
    parts[index] = kernels.penalties(task, share, index * kGaussians, std::min((index + 1) * kGaussians, task.count));
  });
  Penalties total{0, 0};  // in the order of the Gaussians
  for (int64_t index = 0; index < pieces; ++index) {
    total.position += parts[index].position;
    total.scale += parts[index].scale;
  }
  return {task.position_weight * share * total.position, task.scale_weight * share * total.scale};
}

void observe_view(const ViewStatistics& task) {
  const TrainingKernels& kernels = training_kernels();
  parallel_for((task.count + kGaussians - 1) / kGaussians, [&](int64_t index) {
    kernels.observe(task, index * kGaussians, std::min((index + 1) * kGaussians, task.count));
  });
}

PixelBox box_of_nonzero(const float* values, int width, int height) {
  constexpr int kRows = 64;
  const int pieces = (height + kRows - 1) / kRows;
  thread_local std::vector<PixelBox> boxes;
  boxes.resize(pieces);
  PixelBox* const parts = boxes.data();
  parallel_for(pieces, [&](int64_t piece) {
    const int first = static_cast<int>(piece) * kRows;
    parts[piece] = box_of_rows(values, width, first, std::min(first + kRows, height));
  });
  PixelBox whole{width, height, 0, 0};
  for (const PixelBox& part : boxes) {
    if (part.right == 0) continue;
    whole = {std::min(whole.left, part.left), std::min(whole.top, part.top), std::max(whole.right, part.right),
             std::max(whole.bottom, part.bottom)};
  }
  return whole.right == 0 ? PixelBox{0, 0, 0, 0} : whole;
}

double mean_squared_difference(const float* image, const uint8_t* bytes, int64_t count) {
  double total = 0;  // by pieces, in their order: float sums within a piece stay exact enough
  for (int64_t first = 0; first < count; first += kElements) {
    const int64_t piece = std::min(kElements, count - first);
    total += training_kernels().squared_difference(image + first, bytes + first, piece);
  }
  return total / static_cast<double>(std::max<int64_t>(count, 1));
}

double absolute_difference(const float* values, const uint8_t* bytes, int64_t count, float weight, float* gradient) {
  const float share = weight / static_cast<float>(std::max<int64_t>(count, 1));
  const int64_t pieces = (count + kElements - 1) / kElements;
  thread_local std::vector<double> sums;
  sums.resize(pieces);
  double* const parts = sums.data();
  const TrainingKernels& kernels = training_kernels();
  parallel_for(pieces, [&](int64_t piece) {
    const int64_t first = piece * kElements;
    parts[piece] = kernels.absolute_difference(values + first, bytes + first, share, gradient + first,
                                               std::min(kElements, count - first));
  });
  double total = 0;
  for (int64_t piece = 0; piece < pieces; ++piece) total += parts[piece];
  return static_cast<double>(share) * total;
}

double color_difference(const ColorDifference& task) {
  const float share = task.weight / static_cast<float>(std::max<int64_t>(3 * task.pixels, 1));
  const int64_t pieces = (task.pixels + kElements - 1) / kElements;
  thread_local std::vector<double> sums;
  sums.resize(pieces);
  double* const parts = sums.data();
  parallel_for(pieces, [&](int64_t piece) {
    const int64_t end = std::min((piece + 1) * kElements, task.pixels);
    double total = 0;
    for (int64_t pixel = piece * kElements; pixel < end; ++pixel) {
      const bool counts = !task.counted || task.counted[pixel];
      for (int64_t i = 3 * pixel; i < 3 * pixel + 3; ++i) {
        const float difference = task.image[i] - static_cast<float>(task.bytes[i]) * (1.0f / 255);
        const float costs = counts ? std::max(std::abs(difference) - task.free, 0.0f) : 0.0f;
        total += costs;
        task.gradient[i] = costs > 0 ? std::copysign(share, difference) : 0.0f;
      }
    }
    parts[piece] = total;
  });
  double total = 0;
  for (int64_t piece = 0; piece < pieces; ++piece) total += parts[piece];
  return static_cast<double>(share) * total;
}

}  // namespace mien
