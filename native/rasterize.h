// The contract of the Gaussian rasterizer: plain structs over float32 arrays, a forward and a backward pass.
// native/README.md has the algorithm on one page; src/mien/render/projection.py has the formulas.
#pragma once

#include <cstdint>
#include <memory>

namespace mien {

struct GaussianArrays {
  int64_t count;
  int sh_count;            // 1, 4, 9 or 16
  const float* means;      // [n, 3] metres, in the world of the view
  const float* quats;      // [n, 4] wxyz, any length
  const float* scales;     // [n, 3] standard deviations, metres
  const float* opacities;  // [n] 0..1
  const float* sh;         // [n, k, 3]
};

struct GaussianGradients {
  float* means;
  float* quats;
  float* scales;
  float* opacities;
  float* sh;
  float* means2d;  // [n, 2] with respect to the projected centres, per pixel
};

struct View {
  float rotation[9], translation[3];  // T_camera_world
  float fx, fy, cx, cy;               // pixels
  int width, height;
  float background[3];
};

// The order of the sums in ViewGradient::values.
constexpr int kViewGradients = 16;  // rotation [9], translation [3], fx, fy, cx, cy

struct Picture {
  float* image;    // [h, w, 3]
  float* alpha;    // [h, w]
  int32_t* radii;  // [n]
};

struct PictureGradient {
  const float* image;       // [h, w, 3], the forward result
  const float* alpha;       // [h, w], the forward result
  const float* grad_image;  // [h, w, 3]
  const float* grad_alpha;  // [h, w], or null for zero
};

// What the backward pass needs of its forward pass. Comes from a free list and returns there when it is destroyed, so
// a training loop allocates nothing; any number may be alive at a time.
struct Frame;
struct ReturnFrame {
  void operator()(Frame* frame) const noexcept;
};
using FramePtr = std::unique_ptr<Frame, ReturnFrame>;

// Tiles along a side, which are counted in 16 bits, times their size.
constexpr int kMostPictureSide = 32767 * 32;
// Pairs of a Gaussian and a tile that it touches: they are counted in 32 bits, with room for what looks ahead.
constexpr int64_t kMostPairs = 2'000'000'000;

// Null if an input that was read is NaN or infinite; the picture is then undefined. Without `differentiable` there can
// be no backward pass. A picture has 1 to kMostPictureSide pixels along each side (the caller checks). Throws
// std::length_error where there are more than kMostPairs, before their memory is taken.
FramePtr rasterize_forward(const GaussianArrays& gaussians, const View& view, const Picture& picture,
                           bool differentiable);

// Writes all of `gradients` and `view_gradient` [kViewGradients]. A second call with one frame waits for the first.
void rasterize_backward(Frame& frame, const GaussianArrays& gaussians, const View& view, const PictureGradient& picture,
                        const GaussianGradients& gradients, float* view_gradient);

// The instruction set of the kernels in use: "avx512", "avx2", "sse4" or "baseline".
const char* rasterize_isa();
// Chooses one by name (tests and benchmarks); false if this machine or build lacks it.
bool set_rasterize_isa(const char* name);

}  // namespace mien
