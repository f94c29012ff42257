#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <optional>
#include <utility>
#include <vector>

#include "arrays.h"
#include "expression_change.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename A>
std::vector<float> copy_of(const A& array) {
  return {array.data(), array.data() + array.size()};
}

// Activations [inputs] -> [rank] in blocks.
mien::ActivationArrays along(const In<-1>& rest, const In<-1, -1>& directions, const In<-1, -1>& seen, size_t block) {
  const size_t rank = directions.shape(1);
  require(directions.shape(0) == rest.shape(0) && (seen.shape(0) == 0 || seen.shape(1) == rank),
          "the arrays do not fit each other");
  require(block >= 1 && rank >= 1 && rank % block == 0, "activations must be whole blocks");
  return {copy_of(rest), copy_of(directions), copy_of(seen), static_cast<int64_t>(rank), static_cast<int64_t>(block)};
}

mien::FaceActivations make_face_activations(const In<-1>& rest, const In<-1, -1>& directions, const In<-1, -1>& seen,
                                            const std::optional<In<-1, -1>>& shares,
                                            const std::optional<In<6>>& head_rest,
                                            const std::optional<In<6, -1>>& head_directions,
                                            const std::optional<In<-1, -1>>& head_seen) {
  const size_t regions = shares ? shares->shape(1) : 1;
  require(regions >= 1 && directions.shape(1) % regions == 0, "every region must have as many activations");
  mien::FaceActivations face{along(rest, directions, seen, directions.shape(1) / regions), {}, {}, {}};
  if (shares) face.shares = copy_of(*shares);
  require(head_rest.has_value() == head_directions.has_value() && head_rest.has_value() == head_seen.has_value(),
          "the arrays do not fit each other");
  if (!head_rest || head_directions->shape(1) == 0) return face;
  const size_t rank = head_directions->shape(1);
  require(head_seen->shape(0) == 0 || head_seen->shape(1) == rank, "the arrays do not fit each other");
  face.head_rest = copy_of(*head_rest);
  face.head = {std::vector<float>(6), copy_of(*head_directions), copy_of(*head_seen), static_cast<int64_t>(rank),
               static_cast<int64_t>(rank)};
  return face;
}

void activation_table(const mien::FaceActivations& face, const Array<const float>& expression,
                      const Array<const float>& joints, const Array<const float>& rotation,
                      const Array<const float>& translation, const Out<-1, -1>& out) {
  std::vector<float> inputs = copy_of(expression), pose = copy_of(rotation);
  inputs.insert(inputs.end(), joints.data(), joints.data() + joints.size());
  pose.insert(pose.end(), translation.data(), translation.data() + translation.size());
  require(inputs.size() == face.own.rest.size() && pose.size() == 6, "the face does not fit the activations");
  require(has_shape(out, face.rows(), face.width()), "there must be a row for each triangle");
  const nb::gil_scoped_release release;
  mien::activation_table(face, inputs.data(), pose.data(), out.data());
}

// Bases [n, .., r] for values [n, ..].
template <typename Basis, typename Values>
mien::ExpressionBases checked_bases(const Basis& basis, const Values& values, const In<-1, -1>& activations,
                                    const std::optional<Rows>& rows) {
  require(values.ndim() >= 1 && basis.ndim() == values.ndim() + 1, "a basis must have one axis more than its values");
  const size_t rank = basis.shape(values.ndim()), count = values.shape(0);
  require(rank <= activations.shape(1) &&
              std::equal(values.shape_ptr(), values.shape_ptr() + values.ndim(), basis.shape_ptr()),
          "a basis must have the shape of its values, followed by at most as many columns as activations");
  const int64_t each = count == 0 ? 0 : static_cast<int64_t>(values.size() / count);
  return {static_cast<int64_t>(count), each,
          static_cast<int64_t>(rank),  static_cast<int64_t>(activations.shape(1)),
          activations.data(),          checked_rows(rows, count, activations.shape(0))};
}

void expression_change(const Array<const float>& basis, const In<-1, -1>& activations, const std::optional<Rows>& rows,
                       const Array<float>& out) {
  const mien::ExpressionBases bases = checked_bases(basis, out, activations, rows);
  const nb::gil_scoped_release release;
  mien::expression_change(bases, basis.data(), out.data());
}

}  // namespace

void bind_expression_change(nb::module_& module) {
  nb::class_<mien::FaceActivations>(module, "FaceActivations", "What turns a face into activations of its triangles.");
  module.def(
      "activation_shape", [](const mien::FaceActivations& face) { return std::pair(face.rows(), face.width()); },
      "face"_a, "Returns the numbers of rows and of activations of a table.");
  module.def("make_face_activations", &make_face_activations, "rest"_a, "directions"_a, "seen"_a, "shares"_a.none(),
             "head_rest"_a.none(), "head_directions"_a.none(), "head_seen"_a.none(), "Copies the arrays.");
  module.def("activation_table", &activation_table, "face"_a, "expression"_a, "joints"_a, "rotation"_a, "translation"_a,
             "out"_a.noconvert(), "Fills the activations of all triangles.");
  module.def(
      "expression_change", &expression_change, "basis"_a.noconvert(), "activations"_a, "rows"_a.none(),
      "out"_a.noconvert(),
      "Fills the changes [n, ..] of a basis [n, .., r] by rows of activations [.., r], the first if rows is None.");
}
