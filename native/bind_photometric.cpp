#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <array>
#include <optional>

#include "arrays.h"
#include "photometric.h"
#include "training.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T>
using Picture = Array<T, nb::shape<-1, -1, 3>>;
constexpr int kMargin = 6;  // pixels: one more than the reach of the window

// The part of the picture that is compared: the box and all of `drawn` (one number per pixel, 0 for nothing), with a
// margin beyond the reach of windows. Without `drawn`, it is the box.
mien::Box compared(const std::array<int, 4>& box, const std::optional<In<-1, -1>>& drawn, int width, int height) {
  const int left = box[0], top = box[1];
  require(left >= 0 && top >= 0 && box[2] >= 0 && box[3] >= 0 && left <= width && top <= height &&
              box[2] <= width - left && box[3] <= height - top,
          "the box must lie inside the picture");
  const int right = left + box[2], bottom = top + box[3];
  if (!drawn) return {left, top, right, bottom};
  mien::PixelBox all = mien::box_of_nonzero(drawn->data(), width, height);
  if (box[2] > 0 && box[3] > 0) {
    all = all.right == 0 ? mien::PixelBox{left, top, right, bottom}
                         : mien::PixelBox{std::min(all.left, left), std::min(all.top, top), std::max(all.right, right),
                                          std::max(all.bottom, bottom)};
  }
  if (all.right == 0) return {0, 0, 0, 0};
  return {std::max(all.left - kMargin, 0), std::max(all.top - kMargin, 0), std::min(all.right + kMargin, width),
          std::min(all.bottom + kMargin, height)};
}

void photometric_loss(const std::array<int, 4>& box, const std::array<double, 2>& weights,
                      const Picture<const float>& image, const nb::ndarray<nb::c_contig, nb::device::cpu>& target,
                      const std::optional<In<-1, -1>>& drawn, const std::optional<Picture<float>>& gradient,
                      const Array<float, nb::shape<>>& loss) {
  const auto [width, height] = picture_size(image);
  const bool bytes = target.dtype() == nb::dtype<uint8_t>();
  require(bytes || target.dtype() == nb::dtype<float>(), "the target must be float32 or uint8");
  require(bytes || reinterpret_cast<uintptr_t>(target.data()) % alignof(float) == 0, "the target must be aligned");
  require(same_shape(target, image) && (!gradient || same_shape(*gradient, image)) &&
              (!drawn || has_shape(*drawn, height, width)),
          "the pictures must be equally large");
  require(width >= 6, "a picture must be at least 6 pixels wide");
  const nb::gil_scoped_release release;
  const mien::Box inside = compared(box, drawn, width, height);
  if (inside.left >= inside.right || inside.top >= inside.bottom) {
    if (gradient) std::fill_n(gradient->data(), gradient->size(), 0.0f);
    *loss.data() = 0;
    return;
  }
  *loss.data() = static_cast<float>(mien::photometric_loss(
      {image.data(), bytes ? nullptr : static_cast<const float*>(target.data()),
       bytes ? static_cast<const uint8_t*>(target.data()) : nullptr, width, height, inside,
       static_cast<float>(weights[0]), static_cast<float>(weights[1]), gradient ? gradient->data() : nullptr}));
}

}  // namespace

void bind_photometric(nb::module_& module) {
  module.def("photometric_loss", &photometric_loss, "box"_a, "weights"_a, "image"_a, "target"_a.noconvert(),
             "drawn"_a.none(), "gradient"_a.none(), "loss"_a,
             "Fills the loss and its gradient within a box. If `drawn` is given, the box grows to hold all of it and a "
             "margin.");
}
