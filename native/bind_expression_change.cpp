#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>

#include "arrays.h"
#include "expression_change.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// The rank of a basis [.., r] for values [..].
template <typename Basis, typename Values>
int checked_rank(const Basis& basis, const Values& values, const In<-1>& activations) {
  const size_t rank = activations.shape(0);
  require(rank >= 1 && rank <= mien::kMostExpressionRank, "there must be 1 to 8 activations");
  require(basis.ndim() == values.ndim() + 1 && basis.shape(values.ndim()) == rank &&
              std::equal(values.shape_ptr(), values.shape_ptr() + values.ndim(), basis.shape_ptr()),
          "a basis must have the shape of its values, followed by the activations");
  return static_cast<int>(rank);
}

mien::ActivationArrays activation_arrays(const In<-1>& inputs, const In<-1>& rest, const In<-1, -1>& directions,
                                         const In<-1, -1>& seen, size_t rank) {
  const size_t count = inputs.shape(0);
  require(rest.shape(0) == count && has_shape(directions, count, rank) && seen.shape(1) == rank,
          "the arrays do not fit each other");
  return {inputs.data(), static_cast<int64_t>(count),        rest.data(), directions.data(), static_cast<int64_t>(rank),
          seen.data(),   static_cast<int64_t>(seen.shape(0))};
}

void expression_activations(const In<-1>& inputs, const In<-1>& rest, const In<-1, -1>& directions,
                            const In<-1, -1>& seen, const Out<-1>& out) {
  const mien::ActivationArrays arrays = activation_arrays(inputs, rest, directions, seen, out.shape(0));
  const nb::gil_scoped_release release;
  mien::expression_activations(arrays, out.data());
}

void expression_activations_backward(const In<-1>& inputs, const In<-1>& rest, const In<-1, -1>& directions,
                                     const In<-1, -1>& seen, const In<-1>& gradient, const Out<-1>& grad_inputs) {
  const mien::ActivationArrays arrays = activation_arrays(inputs, rest, directions, seen, gradient.shape(0));
  require(same_shape(grad_inputs, inputs), "a gradient must have the shape of its array");
  const nb::gil_scoped_release release;
  mien::expression_activations_backward(arrays, gradient.data(), grad_inputs.data());
}

void expression_change(const Array<const float>& basis, const In<-1>& activations, const Array<float>& out) {
  const int rank = checked_rank(basis, out, activations);
  const nb::gil_scoped_release release;
  mien::expression_change(basis.data(), activations.data(), rank, static_cast<int64_t>(out.size()), out.data());
}

void expression_change_backward(const Array<const float>& basis, const In<-1>& activations,
                                const Array<const float>& gradient, const Array<float>& grad_basis,
                                const Out<-1>& grad_activations) {
  const int rank = checked_rank(basis, gradient, activations);
  require(same_shape(grad_basis, basis) && same_shape(grad_activations, activations),
          "a gradient must have the shape of its array");
  const nb::gil_scoped_release release;
  mien::expression_change_backward(basis.data(), activations.data(), gradient.data(), rank,
                                   static_cast<int64_t>(gradient.size()), grad_basis.data(), grad_activations.data());
}

}  // namespace

void bind_expression_change(nb::module_& module) {
  module.def("expression_activations", &expression_activations, "inputs"_a.noconvert(), "rest"_a, "directions"_a,
             "seen"_a, "out"_a.noconvert(), "Fills the activations of one face.");
  module.def("expression_activations_backward", &expression_activations_backward, "inputs"_a.noconvert(), "rest"_a,
             "directions"_a, "seen"_a, "gradient"_a, "grad_inputs"_a.noconvert(),
             "Fills the gradient of the inputs of one face.");
  module.def("expression_change", &expression_change, "basis"_a.noconvert(), "activations"_a, "out"_a.noconvert(),
             "Fills the changes [..] of a basis [.., r].");
  module.def("expression_change_backward", &expression_change_backward, "basis"_a.noconvert(), "activations"_a,
             "gradient"_a.noconvert(), "grad_basis"_a.noconvert(), "grad_activations"_a,
             "Fills the gradients of the basis and of the activations.");
}
