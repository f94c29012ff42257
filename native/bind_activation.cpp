#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "activation.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

void sigmoid(const nb::ndarray<const float, nb::c_contig, nb::device::cpu>& values,
             const nb::ndarray<float, nb::c_contig, nb::device::cpu>& out) {
  if (values.size() != out.size()) throw nb::value_error("the output does not fit");
  const nb::gil_scoped_release release;
  mien::sigmoid(values.data(), static_cast<int64_t>(values.size()), out.data());
}

void sigmoid_backward(const nb::ndarray<const float, nb::c_contig, nb::device::cpu>& outputs,
                      const nb::ndarray<const float, nb::c_contig, nb::device::cpu>& gradient,
                      const nb::ndarray<float, nb::c_contig, nb::device::cpu>& out) {
  if (outputs.size() != out.size() || gradient.size() != out.size()) throw nb::value_error("the output does not fit");
  const nb::gil_scoped_release release;
  mien::sigmoid_backward(outputs.data(), gradient.data(), static_cast<int64_t>(out.size()), out.data());
}

}  // namespace

void bind_activation(nb::module_& module) {
  module.def("sigmoid", &sigmoid, "values"_a.noconvert(), "out"_a.noconvert());
  module.def("sigmoid_backward", &sigmoid_backward, "outputs"_a.noconvert(), "gradient"_a.noconvert(),
             "out"_a.noconvert(), "The gradient with respect to the values, from the sigmoid's outputs and theirs.");
}
