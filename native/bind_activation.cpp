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

}  // namespace

void bind_activation(nb::module_& module) {
  module.def("sigmoid", &sigmoid, "values"_a.noconvert(), "out"_a.noconvert());
}
