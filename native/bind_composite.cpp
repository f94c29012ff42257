#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <array>

#include "arrays.h"
#include "composite.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Pixels = Array<const uint8_t, nb::shape<-1, -1, 3>>;

void composite(const Pixels& image, const Array<const uint8_t, nb::shape<-1, -1>>& matte,
               const std::array<uint8_t, 3>& background, const std::array<int, 4>& box,
               const Array<uint8_t, nb::shape<-1, -1, 3>>& picture) {
  const auto [width, height] = picture_size(image);
  require(has_shape(matte, height, width) && same_shape(picture, image), "the pictures must be equally large");
  const auto [left, top, across, down] = box;
  require(left >= 0 && top >= 0 && across >= 0 && down >= 0 && left <= width && top <= height &&
              across <= width - left && down <= height - top,
          "the box must lie inside the picture");
  const nb::gil_scoped_release release;
  mien::composite({image.data(),
                   matte.data(),
                   width,
                   height,
                   {background[0], background[1], background[2]},
                   {left, top, left + across, top + down},
                   picture.data()});
}

}  // namespace

void bind_composite(nb::module_& module) {
  module.def("composite", &composite, "image"_a, "matte"_a, "background"_a, "box"_a, "picture"_a,
             "Fills the picture: the image over a colour, blended by the matte within the box, the colour outside.");
}
