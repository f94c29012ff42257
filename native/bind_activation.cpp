#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "activation.h"
#include "arrays.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

void sigmoid(const Array<const float>& values, const Array<float>& out) {
  require(same_shape(values, out), "the output does not fit");
  const nb::gil_scoped_release release;
  mien::sigmoid(values.data(), static_cast<int64_t>(values.size()), out.data());
}

void sigmoid_backward(const Array<const float>& outputs, const Array<const float>& gradient, const Array<float>& out) {
  require(same_shape(outputs, out) && same_shape(gradient, out), "the output does not fit");
  const nb::gil_scoped_release release;
  mien::sigmoid_backward(outputs.data(), gradient.data(), static_cast<int64_t>(out.size()), out.data());
}

}  // namespace

void bind_activation(nb::module_& module) {
  module.def("sigmoid", &sigmoid, "values"_a.noconvert(), "out"_a.noconvert());
  module.def("sigmoid_backward", &sigmoid_backward, "outputs"_a.noconvert(), "gradient"_a.noconvert(),
             "out"_a.noconvert(), "Fills the gradient of the values, from the outputs and their gradient.");
}
