#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <optional>

#include "arrays.h"
#include "expression_change.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

void expression_activations(const In<-1>& inputs, const In<-1>& rest, const In<-1, -1>& directions,
                            const In<-1, -1>& seen, size_t block, const Out<-1>& out) {
  const size_t count = inputs.shape(0), rank = out.shape(0);
  require(rest.shape(0) == count && has_shape(directions, count, rank) && seen.shape(1) == rank,
          "the arrays do not fit each other");
  require(block >= 1 && rank % block == 0, "activations must be whole blocks");
  const nb::gil_scoped_release release;
  mien::expression_activations(
      {inputs.data(), static_cast<int64_t>(count), rest.data(), directions.data(), static_cast<int64_t>(rank),
       static_cast<int64_t>(block), seen.data(), static_cast<int64_t>(seen.shape(0))},
      out.data());
}

void head_motion(const In<6>& rest, const In<6>& pose, const Out<6>& out) {
  mien::head_motion(rest.data(), pose.data(), out.data());
}

void blend_regions(const In<-1, -1>& shares, const In<-1, -1>& table, const Out<-1, -1>& out) {
  require(table.shape(0) == shares.shape(1) && has_shape(out, shares.shape(0), table.shape(1)),
          "the arrays do not fit each other");
  const nb::gil_scoped_release release;
  mien::blend_regions(shares.data(), table.data(), static_cast<int64_t>(shares.shape(0)),
                      static_cast<int64_t>(shares.shape(1)), static_cast<int64_t>(table.shape(1)), out.data());
}

// Bases [n, .., r] for values [n, ..].
template <typename Basis, typename Values>
mien::ExpressionBases checked_bases(const Basis& basis, const Values& values, const In<-1, -1>& activations,
                                    const std::optional<Rows>& rows) {
  const size_t rank = activations.shape(1), count = values.shape(0);
  require(values.ndim() >= 1 && basis.ndim() == values.ndim() + 1 && basis.shape(values.ndim()) == rank &&
              std::equal(values.shape_ptr(), values.shape_ptr() + values.ndim(), basis.shape_ptr()),
          "a basis must have the shape of its values, followed by the activations");
  const int64_t each = count == 0 ? 0 : static_cast<int64_t>(values.size() / count);
  return {static_cast<int64_t>(count), each, static_cast<int64_t>(rank), activations.data(),
          checked_rows(rows, count, activations.shape(0))};
}

void expression_change(const Array<const float>& basis, const In<-1, -1>& activations, const std::optional<Rows>& rows,
                       const Array<float>& out) {
  const mien::ExpressionBases bases = checked_bases(basis, out, activations, rows);
  const nb::gil_scoped_release release;
  mien::expression_change(bases, basis.data(), out.data());
}

void expression_change_backward(const In<-1, -1>& activations, const std::optional<Rows>& rows,
                                const Array<const float>& gradient, const Array<float>& grad_basis) {
  const mien::ExpressionBases bases = checked_bases(grad_basis, gradient, activations, rows);
  const nb::gil_scoped_release release;
  mien::expression_change_backward(bases, gradient.data(), grad_basis.data());
}

}  // namespace

void bind_expression_change(nb::module_& module) {
  module.def("expression_activations", &expression_activations, "inputs"_a.noconvert(), "rest"_a, "directions"_a,
             "seen"_a, "block"_a, "out"_a.noconvert(), "Fills the activations of one face.");
  module.def("head_motion", &head_motion, "rest"_a, "pose"_a, "out"_a.noconvert(),
             "Fills the turns and the shift of a head's pose from another one.");
  module.def("blend_regions", &blend_regions, "shares"_a.noconvert(), "table"_a, "out"_a.noconvert(),
             "Fills the rows [n, k] of a table [g, k] that is blended by shares [n, g].");
  module.def(
      "expression_change", &expression_change, "basis"_a.noconvert(), "activations"_a, "rows"_a.none(),
      "out"_a.noconvert(),
      "Fills the changes [n, ..] of a basis [n, .., r] by rows of activations [.., r], the first if rows is None.");
  module.def("expression_change_backward", &expression_change_backward, "activations"_a, "rows"_a.none(),
             "gradient"_a.noconvert(), "grad_basis"_a.noconvert(), "Fills the gradient of the basis.");
}
