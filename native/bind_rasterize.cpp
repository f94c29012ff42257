#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <optional>
#include <string>

#include "pool.h"
#include "rasterize.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T, typename... Shape>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;
template <int... Shape>
using In = Array<const float, nb::shape<Shape...>>;
template <int... Shape>
using Out = Array<float, nb::shape<Shape...>>;

// Keeps a forward pass's buffers until its backward pass, or until nobody can ask for one.
struct RasterizeFrame {
  mien::FramePtr frame;
  mien::View view;
  int64_t count;
};

void require(bool condition, const char* message) {
  if (!condition) throw nb::value_error(message);
}

mien::GaussianArrays gaussian_arrays(const In<-1, 3>& means, const In<-1, 4>& quats, const In<-1, 3>& scales,
                                     const In<-1>& opacities, const In<-1, -1, 3>& sh) {
  const size_t n = means.shape(0), k = sh.shape(1);
  require(quats.shape(0) == n && scales.shape(0) == n && opacities.shape(0) == n && sh.shape(0) == n,
          "the arrays of the Gaussians must be equally long");
  require(k == 1 || k == 4 || k == 9 || k == 16, "sh must have 1, 4, 9 or 16 coefficients");
  return {static_cast<int64_t>(n), static_cast<int>(k), means.data(), quats.data(),
          scales.data(),           opacities.data(),    sh.data()};
}

mien::View make_view(const In<4, 4>& viewmat, const In<3, 3>& K, int width, int height, const float* background) {
  mien::View view;
  const float *m = viewmat.data(), *k = K.data();
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) view.rotation[3 * row + column] = m[4 * row + column];
    view.translation[row] = m[4 * row + 3];
    view.background[row] = background[row];
  }
  view.fx = k[0];
  view.fy = k[4];
  view.cx = k[2];
  view.cy = k[5];
  view.width = width;
  view.height = height;
  return view;
}

std::optional<RasterizeFrame> forward(const In<-1, 3>& means, const In<-1, 4>& quats, const In<-1, 3>& scales,
                                      const In<-1>& opacities, const In<-1, -1, 3>& sh, const In<3>& background,
                                      const In<4, 4>& viewmat, const In<3, 3>& K, const Out<-1, -1, 3>& image,
                                      const Out<-1, -1>& alpha, const Array<int32_t, nb::shape<-1>>& radii) {
  const auto gaussians = gaussian_arrays(means, quats, scales, opacities, sh);
  require(alpha.shape(0) == image.shape(0) && alpha.shape(1) == image.shape(1), "alpha must be as large as image");
  require(static_cast<int64_t>(radii.shape(0)) == gaussians.count, "radii must have one entry a Gaussian");
  const auto view =
      make_view(viewmat, K, static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0)), background.data());
  const nb::gil_scoped_release release;
  auto frame = mien::rasterize_forward(gaussians, view, {image.data(), alpha.data(), radii.data()});
  if (!frame) return std::nullopt;
  return RasterizeFrame{std::move(frame), view, gaussians.count};
}

void backward(RasterizeFrame& frame, const In<-1, 3>& means, const In<-1, 4>& quats, const In<-1, 3>& scales,
              const In<-1>& opacities, const In<-1, -1, 3>& sh, const In<-1, -1, 3>& image, const In<-1, -1>& alpha,
              const In<-1, -1, 3>& grad_image, const std::optional<In<-1, -1>>& grad_alpha,
              const Out<-1, 3>& grad_means, const Out<-1, 4>& grad_quats, const Out<-1, 3>& grad_scales,
              const Out<-1>& grad_opacities, const Out<-1, -1, 3>& grad_sh, const Out<-1, 2>& grad_means2d,
              const Out<mien::kViewGradients>& grad_view) {
  const auto gaussians = gaussian_arrays(means, quats, scales, opacities, sh);
  const size_t n = means.shape(0), pixels = static_cast<size_t>(frame.view.width) * frame.view.height;
  require(gaussians.count == frame.count, "these are not the Gaussians of the forward pass");
  require(image.size() == 3 * pixels && grad_image.size() == 3 * pixels && alpha.size() == pixels &&
              (!grad_alpha || grad_alpha->size() == pixels),
          "these are not the pictures of the forward pass");
  require(grad_means.shape(0) == n && grad_quats.shape(0) == n && grad_scales.shape(0) == n &&
              grad_opacities.shape(0) == n && grad_sh.size() == sh.size() && grad_means2d.shape(0) == n,
          "a gradient must have the shape of its array");
  const mien::PictureGradient picture{image.data(), alpha.data(), grad_image.data(),
                                      grad_alpha ? grad_alpha->data() : nullptr};
  const mien::GaussianGradients gradients{grad_means.data(),     grad_quats.data(), grad_scales.data(),
                                          grad_opacities.data(), grad_sh.data(),    grad_means2d.data()};
  const nb::gil_scoped_release release;
  mien::rasterize_backward(*frame.frame, gaussians, frame.view, picture, gradients, grad_view.data());
}

}  // namespace

void bind_rasterize(nb::module_& module) {
  nb::class_<RasterizeFrame>(module, "RasterizeFrame", "What a backward pass needs of its forward pass.");
  module.def("rasterize_forward", &forward, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "background"_a,
             "viewmat"_a, "K"_a, "image"_a, "alpha"_a, "radii"_a,
             "Fills image, alpha and radii; None where an input is NaN or infinite.");
  module.def("rasterize_backward", &backward, "frame"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a,
             "image"_a, "alpha"_a, "grad_image"_a, "grad_alpha"_a.none(), "grad_means"_a, "grad_quats"_a,
             "grad_scales"_a, "grad_opacities"_a, "grad_sh"_a, "grad_means2d"_a, "grad_view"_a,
             "Fills the gradients; grad_view is that of the viewmat's rotation and translation, then fx, fy, cx, cy.");
  module.def("thread_count", &mien::thread_count, "The number of threads that native operations use.");
  module.def("set_thread_count", &mien::set_thread_count, "count"_a, "Replaces the threads; 0 for the default.");
  module.def("rasterize_isa", &mien::rasterize_isa, "The instruction set of the rasterizer's kernels.");
  module.def(
      "set_rasterize_isa", [](const std::string& name) { return mien::set_rasterize_isa(name.c_str()); }, "name"_a,
      "Chooses the instruction set; False if it is not there.");
}
