#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <array>
#include <optional>

#include "photometric.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T>
using Picture = nb::ndarray<T, nb::c_contig, nb::device::cpu, nb::shape<-1, -1, 3>>;

template <typename Target>
double photometric_loss(const Picture<const float>& image, const Picture<const Target>& target,
                        const std::array<int, 4>& box, double l1_weight, double ssim_weight,
                        const std::optional<Picture<float>>& gradient) {
  const int height = static_cast<int>(image.shape(0)), width = static_cast<int>(image.shape(1));
  const auto same_size = [&](const auto& other) {
    return other.shape(0) == image.shape(0) && other.shape(1) == image.shape(1);
  };
  if (!same_size(target) || (gradient && !same_size(*gradient))) throw nb::value_error("pictures differ in size");
  const int left = box[0], top = box[1], right = left + box[2], bottom = top + box[3];
  if (width < 6 || left < 0 || top < 0 || right > width || bottom > height || left >= right || top >= bottom) {
    throw nb::value_error("the box must lie inside a picture at least 6 pixels wide");
  }
  mien::PhotometricTask task{image.data(),
                             nullptr,
                             nullptr,
                             width,
                             height,
                             {left, top, right, bottom},
                             static_cast<float>(l1_weight),
                             static_cast<float>(ssim_weight),
                             gradient ? gradient->data() : nullptr};
  if constexpr (std::is_same_v<Target, float>) {
    task.target = target.data();
  } else {
    task.target_bytes = target.data();
  }
  const nb::gil_scoped_release release;
  return mien::photometric_loss(task);
}

}  // namespace

void bind_photometric(nb::module_& module) {
  module.def("photometric_loss", &photometric_loss<float>, "image"_a.noconvert(), "target"_a.noconvert(), "box"_a,
             "l1_weight"_a, "ssim_weight"_a, "gradient"_a.noconvert().none());
  module.def("photometric_loss", &photometric_loss<uint8_t>, "image"_a.noconvert(), "target"_a.noconvert(), "box"_a,
             "l1_weight"_a, "ssim_weight"_a, "gradient"_a.noconvert().none());
}
