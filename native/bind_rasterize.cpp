#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <string>
#include <vector>

#include "arrays.h"
#include "pool.h"
#include "rasterize.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// Keeps a forward pass's buffers until its backward pass, or until nobody can ask for one.
struct RasterizeFrame {
  mien::FramePtr frame;
  mien::View view;
  int64_t count;
  int sh_count;
  bool differentiable;
};

mien::GaussianArrays gaussian_arrays(const In<-1, 3>& means, const In<-1, 4>& quats, const In<-1, 3>& scales,
                                     const In<-1>& opacities, const In<-1, -1, 3>& sh) {
  const size_t n = means.shape(0), k = sh.shape(1);
  checked_length(n, "Gaussians");
  require(quats.shape(0) == n && scales.shape(0) == n && opacities.shape(0) == n && sh.shape(0) == n,
          "the arrays of the Gaussians must be equally long");
  require(k == 1 || k == 4 || k == 9 || k == 16, "sh must have 1, 4, 9 or 16 coefficients");
  return {static_cast<int64_t>(n), static_cast<int>(k), means.data(), quats.data(),
          scales.data(),           opacities.data(),    sh.data()};
}

mien::View make_view(const In<4, 4>& viewmat, const In<3, 3>& K, PictureSize size, const float* background) {
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
  view.width = size.width;
  view.height = size.height;
  return view;
}

// The tuple, if it has as many items as there are arrays.
const nb::tuple& checked(const nb::tuple& task, size_t length) {
  if (task.size() == length) return task;
  throw nb::type_error(
      ("a view is a tuple of " + std::to_string(length) + " items, not of " + std::to_string(task.size())).c_str());
}

RasterizeFrame& frame_of(const nb::tuple& task) {
  RasterizeFrame* frame = nullptr;
  if (nb::try_cast<RasterizeFrame*>(task[0], frame, false) && frame) return *frame;
  throw nb::type_error("frame: what `rasterize_views` returned belongs there");
}

// One view's arrays, in the order of the tuple.
struct ForwardTask {
  In<-1, 3> means;
  In<-1, 4> quats;
  In<-1, 3> scales;
  In<-1> opacities;
  In<-1, -1, 3> sh;
  In<3> background;
  In<4, 4> viewmat;
  In<3, 3> K;
  Out<-1, -1, 3> image;
  Out<-1, -1> alpha;
  Array<int32_t, nb::shape<-1>> radii;

  explicit ForwardTask(const nb::tuple& t)
      : means(item<In<-1, 3>>(checked(t, 11), 0, "means")),
        quats(item<In<-1, 4>>(t, 1, "quats")),
        scales(item<In<-1, 3>>(t, 2, "scales")),
        opacities(item<In<-1>>(t, 3, "opacities")),
        sh(item<In<-1, -1, 3>>(t, 4, "sh")),
        background(item<In<3>>(t, 5, "background")),
        viewmat(item<In<4, 4>>(t, 6, "viewmat")),
        K(item<In<3, 3>>(t, 7, "K")),
        image(item<Out<-1, -1, 3>>(t, 8, "image")),
        alpha(item<Out<-1, -1>>(t, 9, "alpha")),
        radii(item<Array<int32_t, nb::shape<-1>>>(t, 10, "radii")) {
    const PictureSize size = picture_size(image);
    require(size.width > 0 && size.height > 0, "a picture must have pixels");
    require(has_shape(alpha, size.height, size.width), "alpha must be as large as image");
    require(radii.shape(0) == means.shape(0), "radii must have one entry a Gaussian");
  }
  mien::GaussianArrays gaussians() const { return gaussian_arrays(means, quats, scales, opacities, sh); }
  mien::View view() const { return make_view(viewmat, K, picture_size(image), background.data()); }
};

struct BackwardTask {
  RasterizeFrame& frame;
  In<-1, 3> means;
  In<-1, 4> quats;
  In<-1, 3> scales;
  In<-1> opacities;
  In<-1, -1, 3> sh;
  In<-1, -1, 3> image;
  In<-1, -1> alpha;
  In<-1, -1, 3> grad_image;
  std::optional<In<-1, -1>> grad_alpha;
  Out<-1, 3> grad_means;
  Out<-1, 4> grad_quats;
  Out<-1, 3> grad_scales;
  Out<-1> grad_opacities;
  Out<-1, -1, 3> grad_sh;
  Out<-1, 2> grad_means2d;
  Out<4, 4> grad_viewmat;
  Out<3, 3> grad_K;

  explicit BackwardTask(const nb::tuple& t)
      : frame(frame_of(checked(t, 18))),
        means(item<In<-1, 3>>(t, 1, "means")),
        quats(item<In<-1, 4>>(t, 2, "quats")),
        scales(item<In<-1, 3>>(t, 3, "scales")),
        opacities(item<In<-1>>(t, 4, "opacities")),
        sh(item<In<-1, -1, 3>>(t, 5, "sh")),
        image(item<In<-1, -1, 3>>(t, 6, "image")),
        alpha(item<In<-1, -1>>(t, 7, "alpha")),
        grad_image(item<In<-1, -1, 3>>(t, 8, "grad_image")),
        grad_means(item<Out<-1, 3>>(t, 10, "grad_means")),
        grad_quats(item<Out<-1, 4>>(t, 11, "grad_quats")),
        grad_scales(item<Out<-1, 3>>(t, 12, "grad_scales")),
        grad_opacities(item<Out<-1>>(t, 13, "grad_opacities")),
        grad_sh(item<Out<-1, -1, 3>>(t, 14, "grad_sh")),
        grad_means2d(item<Out<-1, 2>>(t, 15, "grad_means2d")),
        grad_viewmat(item<Out<4, 4>>(t, 16, "grad_viewmat")),
        grad_K(item<Out<3, 3>>(t, 17, "grad_K")) {
    if (!t[9].is_none()) grad_alpha = item<In<-1, -1>>(t, 9, "grad_alpha");
    const mien::GaussianArrays own = gaussians();
    const int64_t n = own.count;
    require(frame.differentiable, "the forward pass was not differentiable");
    require(n == frame.count && own.sh_count == frame.sh_count, "these are not the Gaussians of the forward pass");
    require(has_shape(image, frame.view.height, frame.view.width, 3) && same_shape(grad_image, image) &&
                has_shape(alpha, frame.view.height, frame.view.width) &&
                (!grad_alpha || same_shape(*grad_alpha, alpha)),
            "these are not the pictures of the forward pass");
    require(same_shape(grad_means, means) && same_shape(grad_quats, quats) && same_shape(grad_scales, scales) &&
                same_shape(grad_opacities, opacities) && same_shape(grad_sh, sh) && has_shape(grad_means2d, n, 2),
            "a gradient must have the shape of its array");
  }
  mien::GaussianArrays gaussians() const { return gaussian_arrays(means, quats, scales, opacities, sh); }
  void run() const {
    const mien::PictureGradient picture{image.data(), alpha.data(), grad_image.data(),
                                        grad_alpha ? grad_alpha->data() : nullptr};
    const mien::GaussianGradients gradients{grad_means.data(),     grad_quats.data(), grad_scales.data(),
                                            grad_opacities.data(), grad_sh.data(),    grad_means2d.data()};
    float view[mien::kViewGradients];
    mien::rasterize_backward(*frame.frame, gaussians(), frame.view, picture, gradients, view);
    float *m = grad_viewmat.data(), *k = grad_K.data();
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) m[4 * row + column] = view[3 * row + column];
      m[4 * row + 3] = view[9 + row];
    }
    for (int column = 0; column < 4; ++column) m[12 + column] = 0;
    const float intrinsics[9] = {view[12], 0, view[14], 0, view[13], view[15], 0, 0, 0};
    for (int i = 0; i < 9; ++i) k[i] = intrinsics[i];
  }
};

// A single view gets all threads; of several, each gets one.
std::vector<std::optional<RasterizeFrame>> forward(const std::vector<nb::tuple>& views, bool differentiable) {
  const std::vector<ForwardTask> tasks(views.begin(), views.end());
  std::vector<mien::GaussianArrays> gaussians;
  for (const ForwardTask& task : tasks) gaussians.push_back(task.gaussians());
  std::vector<std::optional<RasterizeFrame>> frames(tasks.size());
  const nb::gil_scoped_release release;
  mien::parallel_for(static_cast<int64_t>(tasks.size()), [&](int64_t i) {
    const ForwardTask& task = tasks[i];
    const mien::View view = task.view();
    auto frame = mien::rasterize_forward(gaussians[i], view, {task.image.data(), task.alpha.data(), task.radii.data()},
                                         differentiable);
    if (!frame) return;
    frames[i] = RasterizeFrame{std::move(frame), view, gaussians[i].count, gaussians[i].sh_count, differentiable};
  });
  return frames;
}

void backward(const std::vector<nb::tuple>& views) {
  const std::vector<BackwardTask> tasks(views.begin(), views.end());
  const nb::gil_scoped_release release;
  mien::parallel_for(static_cast<int64_t>(tasks.size()), [&](int64_t i) { tasks[i].run(); });
}

}  // namespace

void bind_rasterize(nb::module_& module) {
  nb::class_<RasterizeFrame>(module, "RasterizeFrame", "What a backward pass needs of its forward pass.");
  module.def(
      "rasterize_forward", [](nb::args view) { return std::move(forward({nb::tuple(view)}, false)[0]); },
      "One view of `rasterize_views`, not differentiable.");
  module.def("rasterize_views", &forward, "views"_a, "differentiable"_a,
             "Fills image, alpha and radii of each view, given as (means, quats, scales, opacities, sh, background, "
             "viewmat, K, image, alpha, radii); None for a view where an input is NaN or infinite. "
             "Unless `differentiable`, what a backward pass needs is left out.");
  module.def("rasterize_views_backward", &backward, "views"_a,
             "Fills the gradients of each view, given as (frame, means, quats, scales, opacities, sh, image, alpha, "
             "grad_image, grad_alpha or None, grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, "
             "grad_means2d, grad_viewmat, grad_K).");
  module.def("thread_count", &mien::thread_count, "The number of threads that native operations use.");
  module.def("set_thread_count", &mien::set_thread_count, "count"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Replaces the threads; 0 for the default.");
  module.def("rasterize_isa", &mien::rasterize_isa, "The instruction set of the rasterizer's kernels.");
  module.def(
      "set_rasterize_isa", [](const std::string& name) { return mien::set_rasterize_isa(name.c_str()); }, "name"_a,
      "Chooses the instruction set; False if it is not there.");
}
