#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "arrays.h"
#include "baked_points.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// Raw attributes of n points and their changes.
struct RawArrays {
  static constexpr char kName[] = "RawPoints";
  static constexpr const char* kFields[] = {"changes", "log_scales", "quats", "opacity_logits", "colors"};
  In<-1, mien::kPointAttributes> changes;
  In<-1, 3> log_scales;
  In<-1, 4> quats;
  In<-1> opacity_logits;
  In<-1, 3> colours;

  explicit RawArrays(const Group<RawArrays>& group) {
    group.read(changes, log_scales, quats, opacity_logits, colours);
    const size_t n = changes.shape(0);
    require(log_scales.shape(0) == n && quats.shape(0) == n && opacity_logits.shape(0) == n && colours.shape(0) == n,
            "raw attributes must be equally long");
  }
};

struct ActivatedArrays {
  static constexpr char kName[] = "ActivatedPoints";
  static constexpr const char* kFields[] = {"scales", "quats", "opacities", "sh"};
  Out<-1, 3> scales;
  Out<-1, 4> quats;
  Out<-1> opacities;
  Out<-1, 1, 3> sh;

  ActivatedArrays(const Group<ActivatedArrays>& group, size_t n) {
    group.read(scales, quats, opacities, sh);
    require(scales.shape(0) == n && quats.shape(0) == n && opacities.shape(0) == n && sh.shape(0) == n,
            "there must be one output per point");
  }
};

void add_bone(const In<-1, 3>& shaped, const In<-1>& weights, const In<3, 4>& transform, const Out<-1, 3>& posed) {
  require(same_shape(shaped, posed) && has_shape(weights, shaped.shape(0)), "points and weights must fit each other");
  const nb::gil_scoped_release release;
  mien::add_bone(shaped.data(), weights.data(), transform.data(), static_cast<int64_t>(shaped.shape(0)), posed.data());
}

void activate_points(const Group<RawArrays>& raw_group, float gain, float offset,
                     const Group<ActivatedArrays>& out_group) {
  const RawArrays raw(raw_group);
  const ActivatedArrays out(out_group, raw.changes.shape(0));
  const mien::RawPoints own{static_cast<int64_t>(raw.changes.shape(0)),
                            raw.changes.data(),
                            raw.log_scales.data(),
                            raw.quats.data(),
                            raw.opacity_logits.data(),
                            raw.colours.data()};
  const mien::ActivatedPoints into{out.scales.data(), out.quats.data(), out.opacities.data(), out.sh.data()};
  const nb::gil_scoped_release release;
  mien::activate_points(own, gain, offset, into);
}

}  // namespace

void bind_baked_points(nb::module_& module) {
  bind_group<RawArrays>(module);
  bind_group<ActivatedArrays>(module);
  module.def("add_bone", &add_bone, "shaped"_a, "weights"_a, "transform"_a, "posed"_a.noconvert(),
             "Adds what a bone that is no joint of the face contributes to posed points.");
  module.def("activate_points", &activate_points, "raw"_a, "gain"_a, "offset"_a, "out"_a,
             "Fills the activated attributes of points, from raw ones and their changes.");
}
