// The two passes: which kernel runs on which data, in parallel.
#include "rasterize.h"

#include <atomic>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "pool.h"
#include "processor.h"
#include "rasterize_frame.h"

namespace mien {

#if defined(__x86_64__) && !defined(MIEN_PORTABLE)
extern const Kernels kernels_avx512, kernels_avx2, kernels_sse4;
#else
extern const Kernels kernels_baseline;
#endif

namespace {

struct Isa {
  const char* name;
  const Kernels* kernels;
  bool here;
};

// Best first.
const std::vector<Isa>& isas() {
#if defined(__x86_64__) && !defined(MIEN_PORTABLE)
  static const std::vector<Isa> all = {
      {"avx512", &kernels_avx512, has_x86_64_v4()},
      {"avx2", &kernels_avx2, has_x86_64_v3()},
      {"sse4", &kernels_sse4, true},
  };
#else
  static const std::vector<Isa> all = {{"baseline", &kernels_baseline, true}};
#endif
  return all;
}

std::atomic<const Isa*> g_isa{nullptr};

// The best one, or the one that MIEN_ISA names.
const Isa& first_isa() {
  const char* wanted = std::getenv("MIEN_ISA");
  std::string here;
  for (const Isa& one : isas()) {
    if (one.here && (!wanted || !*wanted || std::strcmp(one.name, wanted) == 0)) return one;
    if (one.here) here += (here.empty() ? "" : ", ") + std::string(one.name);
  }
  throw std::invalid_argument("MIEN_ISA=" + std::string(wanted) + ": this machine has " + here);
}

const Isa& isa() {
  if (!g_isa) g_isa = &first_isa();
  return *g_isa;
}

// Unused frames. Never destroyed, since arrays may outlive static destructors.
constexpr size_t kSpareFrames = 4;
std::mutex& spare_mutex() {
  static auto* mutex = new std::mutex;
  return *mutex;
}
std::vector<Frame*>& spare_frames() {
  static auto* frames = [] {
    auto* const own = new std::vector<Frame*>;
    own->reserve(kSpareFrames);  // so that giving a frame back never needs memory
    return own;
  }();
  return *frames;
}

FramePtr take_frame() {
  const std::lock_guard<std::mutex> lock(spare_mutex());
  if (spare_frames().empty()) return FramePtr(new Frame);
  Frame* frame = spare_frames().back();
  spare_frames().pop_back();
  return FramePtr(frame);
}

bool is_finite(const View& view) {
  float total = view.fx + view.fy + view.cx + view.cy;
  for (float value : view.rotation) total += value;
  for (float value : view.translation) total += value;
  for (float value : view.background) total += value;
  return std::isfinite(total);
}

// Calls body(tile) for each tile, run by run.
template <typename Body>
void for_tiles(Frame& frame, Body&& body) {
  const int32_t* begins = frame.run_begins.data();
  parallel_for(frame.runs, [&](int64_t run) {
    for (int tile = begins[run]; tile < begins[run + 1]; ++tile) body(tile);
  });
}

int64_t groups(int64_t count) { return (count + kGroup - 1) / kGroup; }

}  // namespace

void ReturnFrame::operator()(Frame* frame) const noexcept {
  const std::lock_guard<std::mutex> lock(spare_mutex());
  if (spare_frames().size() < kSpareFrames) {
    spare_frames().push_back(frame);
  } else {
    delete frame;
  }
}

const char* rasterize_isa() { return isa().name; }

bool set_rasterize_isa(const char* name) {
  for (const Isa& one : isas()) {
    if (one.here && std::strcmp(one.name, name) == 0) {
      g_isa = &one;
      return true;
    }
  }
  return false;
}

FramePtr rasterize_forward(const GaussianArrays& gaussians, const View& view, const Picture& picture,
                           bool differentiable) {
  if (!is_finite(view)) return nullptr;
  const Kernels& kernels = *isa().kernels;
  FramePtr frame = take_frame();
  const int64_t count = gaussians.count;
  Splat* splats = frame->splats.reserve(count);
  frame->columns = (view.width + kTile - 1) / kTile;
  frame->rows = (view.height + kTile - 1) / kTile;
  const Projected projected{{frame->columns, frame->rows},
                            splats,
                            frame->spans.reserve(count),
                            frame->slot_counts.reserve(count),
                            frame->depth_keys.reserve(count),
                            frame->depth_ranges.reserve(groups(count)),
                            picture.radii};
  frame->differentiable = differentiable;
  std::atomic<bool> finite{true};
  parallel_for(groups(count), [&](int64_t group) {
    const int64_t first = group * kGroup, last = std::min(first + kGroup, count);
    if (!kernels.project(gaussians, view, first, last, projected)) finite = false;
  });
  if (!finite) return nullptr;
  sort_by_depth(*frame, count);
  bin_into_tiles(*frame, count);
  const TileLists lists = frame->lists();
  for_tiles(*frame, [&](int tile) { kernels.blend(splats, lists, view, tile, picture.image, picture.alpha); });
  return frame;
}

void rasterize_backward(Frame& frame, const GaussianArrays& gaussians, const View& view, const PictureGradient& picture,
                        const GaussianGradients& gradients, float* view_gradient) {
  const std::lock_guard<std::mutex> lock(frame.backward);
  const Kernels& kernels = *isa().kernels;
  const TileLists lists = frame.lists();
  Moments* slots = frame.slots.reserve(frame.pairs);
  for_tiles(frame, [&](int tile) { kernels.blend_backward(frame.splats.data(), lists, view, tile, picture, slots); });
  const int64_t count = gaussians.count, parts = groups(count);
  float* view_gradients = frame.view_gradients.reserve(parts * kViewGradients);
  parallel_for(parts, [&](int64_t group) {
    const int64_t first = group * kGroup, last = std::min(first + kGroup, count);
    kernels.project_backward(gaussians, view, first, last, frame.slot_begins.data(), slots, gradients,
                             view_gradients + group * kViewGradients);
  });
  // Sums run in the order of the Gaussians, whichever thread computed which part.
  std::memset(view_gradient, 0, sizeof(float) * kViewGradients);
  for (int64_t group = 0; group < parts; ++group) {
    for (int j = 0; j < kViewGradients; ++j) view_gradient[j] += view_gradients[group * kViewGradients + j];
  }
}

}  // namespace mien
