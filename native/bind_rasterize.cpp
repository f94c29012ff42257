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

// The buffers of a forward pass. Python holds it until the backward pass is done or cannot come any more.
struct RasterizeFrame {
  mien::FramePtr frame;
  mien::View view;
  int64_t count;
  int sh_count;
  bool differentiable;
};

// Gaussians: values, or gradients of them.
template <typename T>
struct GaussianArrays {
  static constexpr char kName[] = "GaussianArrays";
  static constexpr const char* kFields[] = {"means", "quats", "scales", "opacities", "sh"};
  Array<T, nb::shape<-1, 3>> means;
  Array<T, nb::shape<-1, 4>> quats;
  Array<T, nb::shape<-1, 3>> scales;
  Array<T, nb::shape<-1>> opacities;
  Array<T, nb::shape<-1, -1, 3>> sh;

  GaussianArrays() = default;
  explicit GaussianArrays(const Group<GaussianArrays>& group) {
    group.read(means, quats, scales, opacities, sh);
    const size_t n = means.shape(0), k = sh.shape(1);
    checked_length(n, "Gaussians");
    require(quats.shape(0) == n && scales.shape(0) == n && opacities.shape(0) == n && sh.shape(0) == n,
            "the arrays of the Gaussians must be equally long");
    require(k == 1 || k == 4 || k == 9 || k == 16, "sh must have 1, 4, 9 or 16 coefficients");
  }
  mien::GaussianArrays of() const {
    return {static_cast<int64_t>(means.shape(0)),
            static_cast<int>(sh.shape(1)),
            means.data(),
            quats.data(),
            scales.data(),
            opacities.data(),
            sh.data()};
  }
};

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

// One view: what is drawn, and the pictures to be filled.
struct ForwardTask {
  static constexpr char kName[] = "RasterizeView";
  static constexpr const char* kFields[] = {"gaussians", "background", "viewmat", "K", "image", "alpha", "radii"};
  Group<GaussianArrays<const float>> gaussian_group;
  GaussianArrays<const float> gaussians;
  In<3> background;
  In<4, 4> viewmat;
  In<3, 3> K;
  Out<-1, -1, 3> image;
  Out<-1, -1> alpha;
  Array<int32_t, nb::shape<-1>> radii;

  explicit ForwardTask(const Group<ForwardTask>& group) {
    group.read(gaussian_group, background, viewmat, K, image, alpha, radii);
    gaussians = GaussianArrays<const float>(gaussian_group);
    const PictureSize size = picture_size(image);
    require(size.width > 0 && size.height > 0, "a picture must have pixels");
    require(has_shape(alpha, size.height, size.width), "alpha must be as large as image");
    require(radii.shape(0) == gaussians.means.shape(0), "radii must have one entry per Gaussian");
  }
  mien::View view() const { return make_view(viewmat, K, picture_size(image), background.data()); }
};

// One view's backward pass: the inputs and results of its forward pass, and the gradients to be filled.
struct BackwardTask {
  static constexpr char kName[] = "RasterizeGradients";
  static constexpr const char* kFields[] = {"frame",        "gaussians",  "image",          "alpha",
                                            "grad_image",   "grad_alpha", "grad_gaussians", "grad_means2d",
                                            "grad_viewmat", "grad_K"};
  RasterizeFrame* frame = nullptr;
  Group<GaussianArrays<const float>> gaussian_group;
  GaussianArrays<const float> gaussians;
  In<-1, -1, 3> image;
  In<-1, -1> alpha;
  In<-1, -1, 3> grad_image;
  std::optional<In<-1, -1>> grad_alpha;
  Group<GaussianArrays<float>> gradient_group;
  GaussianArrays<float> gradients;
  Out<-1, 2> grad_means2d;
  Out<4, 4> grad_viewmat;
  Out<3, 3> grad_K;

  explicit BackwardTask(const Group<BackwardTask>& group) {
    group.read(frame, gaussian_group, image, alpha, grad_image, grad_alpha, gradient_group, grad_means2d, grad_viewmat,
               grad_K);
    if (!frame) throw nb::type_error("RasterizeGradients.frame must be a frame that `rasterize_views` returned");
    gaussians = GaussianArrays<const float>(gaussian_group);
    gradients = GaussianArrays<float>(gradient_group);
    const mien::GaussianArrays own = gaussians.of();
    require(frame->differentiable, "the forward pass was not differentiable");
    require(own.count == frame->count && own.sh_count == frame->sh_count,
            "these are not the Gaussians of the forward pass");
    require(has_shape(image, frame->view.height, frame->view.width, 3) && same_shape(grad_image, image) &&
                has_shape(alpha, frame->view.height, frame->view.width) &&
                (!grad_alpha || same_shape(*grad_alpha, alpha)),
            "these are not the pictures of the forward pass");
    require(same_shape(gradients.means, gaussians.means) && same_shape(gradients.sh, gaussians.sh) &&
                has_shape(grad_means2d, own.count, 2),
            "a gradient must have the shape of its array");
  }
  void run() const {
    const mien::PictureGradient picture{image.data(), alpha.data(), grad_image.data(),
                                        grad_alpha ? grad_alpha->data() : nullptr};
    const mien::GaussianGradients found{gradients.means.data(),     gradients.quats.data(), gradients.scales.data(),
                                        gradients.opacities.data(), gradients.sh.data(),    grad_means2d.data()};
    float view[mien::kViewGradients];
    mien::rasterize_backward(*frame->frame, gaussians.of(), frame->view, picture, found, view);
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

std::vector<std::optional<RasterizeFrame>> draw(const std::vector<ForwardTask>& tasks, bool differentiable) {
  std::vector<std::optional<RasterizeFrame>> frames(tasks.size());
  const nb::gil_scoped_release release;
  mien::parallel_for(static_cast<int64_t>(tasks.size()), [&](int64_t i) {
    const ForwardTask& task = tasks[i];
    const mien::GaussianArrays gaussians = task.gaussians.of();
    const mien::View view = task.view();
    auto frame = mien::rasterize_forward(gaussians, view, {task.image.data(), task.alpha.data(), task.radii.data()},
                                         differentiable);
    if (!frame) return;
    frames[i] = RasterizeFrame{std::move(frame), view, gaussians.count, gaussians.sh_count, differentiable};
  });
  return frames;
}

// A single view uses all threads; several views use one each.
std::vector<std::optional<RasterizeFrame>> forward(const std::vector<Group<ForwardTask>>& views, bool differentiable) {
  return draw({views.begin(), views.end()}, differentiable);
}

void backward(const std::vector<Group<BackwardTask>>& views) {
  const std::vector<BackwardTask> tasks(views.begin(), views.end());
  const nb::gil_scoped_release release;
  mien::parallel_for(static_cast<int64_t>(tasks.size()), [&](int64_t i) { tasks[i].run(); });
}

}  // namespace

void bind_rasterize(nb::module_& module) {
  bind_group<GaussianArrays<float>>(module);
  bind_group<ForwardTask>(module);
  bind_group<BackwardTask>(module);
  nb::class_<RasterizeFrame>(module, "RasterizeFrame", "What a backward pass needs of its forward pass.");
  module.def(
      "rasterize_views", &forward, "views"_a, "differentiable"_a,
      "Fills image, alpha and radii of each view. The result is None for a view with NaN or infinity in an input. "
      "Without `differentiable`, there can be no backward pass.");
  module.def("rasterize_views_backward", &backward, "views"_a, "Fills the gradients of each view.");
  module.def("thread_count", &mien::thread_count, "The number of threads that native operations use.");
  module.def("keep_loops_serial", &mien::keep_loops_serial, "serial"_a,
             "Makes all loops of the calling thread serial, or not: for threads that share the cores between them.");
  module.def("set_thread_count", &mien::set_thread_count, "count"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Sets the number of threads; 0 is the default.");
  module.def("rasterize_isa", &mien::rasterize_isa, "The instruction set of the rasterizer's kernels.");
  module.def(
      "set_rasterize_isa", [](const std::string& name) { return mien::set_rasterize_isa(name.c_str()); }, "name"_a,
      "Chooses the instruction set. Returns False if this machine does not have it.");
}
