#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "arrays.h"
#include "skin_points.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

struct SkinArrays {
  static constexpr char kName[] = "SkinPoints";
  static constexpr const char* kFields[] = {"points", "moved", "weights", "from_bones", "to_bones"};
  In<-1, 3> points;
  In<-1, -1, 3> moved;
  In<-1, -1> weights;
  In<-1, 3, 4> from;
  In<-1, -1, 3, 4> to;

  explicit SkinArrays(const Group<SkinArrays>& group) {
    group.read(points, moved, weights, from, to);
    const size_t n = points.shape(0), b = moved.shape(0), k = from.shape(0);
    checked_length(k, mien::kMostBones, "bones");
    checked_length(b, "poses");
    require(has_shape(moved, b, n, 3) && has_shape(weights, n, k) && has_shape(to, b, k, 3, 4),
            "points, poses and bones must fit each other");
  }
  mien::SkinPoints task() const {
    return {static_cast<int64_t>(points.shape(0)),
            static_cast<int64_t>(moved.shape(0)),
            static_cast<int>(from.shape(0)),
            points.data(),
            moved.data(),
            weights.data(),
            from.data(),
            to.data()};
  }
};

struct SkinGradientArrays {
  static constexpr char kName[] = "SkinPointsGradients";
  static constexpr const char* kFields[] = {"posed", "points", "moved", "weights", "to_bones"};
  In<-1, -1, 3> posed;
  Out<-1, 3> points;
  Out<-1, -1, 3> moved;
  Out<-1, -1> weights;
  Out<-1, -1, 3, 4> to;

  SkinGradientArrays(const Group<SkinGradientArrays>& group, const SkinArrays& own) {
    group.read(posed, points, moved, weights, to);
    require(same_shape(posed, own.moved) && same_shape(points, own.points) && same_shape(moved, own.moved) &&
                same_shape(weights, own.weights) && same_shape(to, own.to),
            "a gradient must have the shape of its array");
  }
};

void skin_points(const Group<SkinArrays>& group, const Out<-1, -1, 3>& posed) {
  const SkinArrays own(group);
  require(same_shape(posed, own.moved), "posed points must have the shape of what moves them");
  const nb::gil_scoped_release release;
  mien::skin_points(own.task(), posed.data());
}

void skin_points_backward(const Group<SkinArrays>& group, const Group<SkinGradientArrays>& gradients) {
  const SkinArrays own(group);
  const SkinGradientArrays out(gradients, own);
  const nb::gil_scoped_release release;
  mien::skin_points_backward(
      own.task(), {out.posed.data(), out.points.data(), out.moved.data(), out.weights.data(), out.to.data()});
}

}  // namespace

void bind_skin_points(nb::module_& module) {
  bind_group<SkinArrays>(module);
  bind_group<SkinGradientArrays>(module);
  module.def("skin_points", &skin_points, "points"_a, "posed"_a.noconvert(),
             "Fills the places of points in other poses of a skeleton.");
  module.def("skin_points_backward", &skin_points_backward, "points"_a, "gradients"_a,
             "Fills the gradients of points, displacements, weights and bones.");
}
