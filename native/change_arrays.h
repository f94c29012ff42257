// The arrays of what changes bound Gaussians, and of their changes, as Python passes them to bind_ride.cpp.
#pragma once

#include <nanobind/stl/optional.h>

#include <optional>
#include <vector>

#include "arrays.h"
#include "bound_changes.h"
#include "factored_terms.h"
#include "rig.h"

template <int... Shape>
using MaybeIn = std::optional<In<Shape...>>;
template <int... Shape>
using MaybeOut = std::optional<Out<Shape...>>;

template <typename A>
auto* data_of(const std::optional<A>& array) {
  return array ? array->data() : nullptr;
}

template <typename T, typename A>
mien::GaussianChanges<T> changes_of(const A& own) {
  return {data_of(own.offset), data_of(own.color), data_of(own.opacity), data_of(own.feature_color),
          data_of(own.feature_opacity)};
}

// First SH coefficients, the activations of triangles, and what they multiply: bases, and features with the layers of
// their network, which has no biases.
struct ChangeArrays {
  static constexpr char kName[] = "ChangeArrays";
  static constexpr const char* kFields[] = {"sh",      "activations",   "offset_basis", "color_basis", "opacity_basis",
                                            "neutral", "feature_bases", "weight1",      "weight2"};
  In<-1, 1, 3> sh;
  In<-1, -1> activations;
  MaybeIn<-1, 3, -1> offset_basis, color_basis;
  MaybeIn<-1, -1> opacity_basis, neutral;
  MaybeIn<-1, -1, -1> feature_bases;
  MaybeIn<-1, -1> weight1, weight2;
  size_t rank = 0;
  std::vector<float> no_biases;
  mien::FeatureNetwork network{};

  ChangeArrays(const Group<ChangeArrays>& group, const mien::RigTopology& topology) {
    group.read(sh, activations, offset_basis, color_basis, opacity_basis, neutral, feature_bases, weight1, weight2);
    const size_t count = topology.face_index.size(), width = activations.shape(1);
    require(sh.shape(0) == count && activations.shape(0) == topology.faces.size() / 3,
            "there must be coefficients for each Gaussian, and activations for each triangle");
    if (offset_basis)
      rank = offset_basis->shape(2);
    else if (color_basis)
      rank = color_basis->shape(2);
    else if (opacity_basis)
      rank = opacity_basis->shape(1);
    require(rank <= width && (!offset_basis || has_shape(*offset_basis, count, 3, rank)) &&
                (!color_basis || has_shape(*color_basis, count, 3, rank)) &&
                (!opacity_basis || has_shape(*opacity_basis, count, rank)),
            "bases must have one row per Gaussian, and no more columns than activations");
    require(neutral.has_value() == feature_bases.has_value() && neutral.has_value() == weight1.has_value() &&
                neutral.has_value() == weight2.has_value(),
            "features need bases and both layers");
    if (!neutral) return;
    const size_t features = neutral->shape(1), hidden = weight1->shape(0);
    require(features >= 1 && hidden >= 1, "features and hidden values must not be empty");
    for (const size_t length : {features, hidden, width}) checked_length(length, kMostWidth, "numbers in a row");
    require(neutral->shape(0) == count && has_shape(*feature_bases, count, width, features) &&
                has_shape(*weight1, hidden, features) && has_shape(*weight2, 4, hidden),
            "features and layers do not fit each other");
    no_biases.assign(hidden + 4, 0.0f);
    network = {static_cast<int64_t>(count),
               static_cast<int>(features),
               0,
               static_cast<int>(hidden),
               4,
               neutral->data(),
               nullptr,
               weight1->data(),
               no_biases.data(),
               weight2->data(),
               no_biases.data() + hidden};
  }
  mien::ChangeBases bases(const mien::RigTopology& topology) const {
    const auto width = static_cast<int64_t>(activations.shape(1));
    const int64_t* const rows = topology.face_index.data();
    return {static_cast<int64_t>(sh.shape(0)),
            static_cast<int64_t>(rank),
            data_of(offset_basis),
            data_of(color_basis),
            data_of(opacity_basis),
            activations.data(),
            width,
            rows,
            neutral ? &network : nullptr,
            {data_of(feature_bases), width, activations.data(), rows}};
  }
};

// The changed coefficients, the changes, and the weighted mean squares of the linear ones and of the features'.
struct ChangedArrays {
  static constexpr char kName[] = "ChangedArrays";
  static constexpr const char* kFields[] = {"sh",     "offset",  "color", "opacity", "feature_color", "feature_opacity",
                                            "linear", "features"};
  Out<-1, 1, 3> sh;
  MaybeOut<-1, 3> offset, color;
  MaybeOut<-1> opacity;
  MaybeOut<-1, 3> feature_color;
  MaybeOut<-1> feature_opacity;
  Out<> linear, features;

  ChangedArrays(const Group<ChangedArrays>& group, const ChangeArrays& own) {
    group.read(sh, offset, color, opacity, feature_color, feature_opacity, linear, features);
    const size_t count = own.sh.shape(0);
    require(has_shape(sh, count, 1, 3) && is_for(offset, own.offset_basis, count) &&
                is_for(color, own.color_basis, count) && is_for(opacity, own.opacity_basis, count) &&
                is_for(feature_color, own.neutral, count) && is_for(feature_opacity, own.neutral, count),
            "there must be a change for each basis, with one row per Gaussian");
  }
  mien::GaussianChanges<float> changes() const { return changes_of<float>(*this); }

 private:
  template <typename A, typename B>
  static bool is_for(const std::optional<A>& change, const std::optional<B>& basis, size_t count) {
    return change.has_value() == basis.has_value() && (!change || change->shape(0) == count);
  }
};

// The gradients of what `ChangedArrays` holds. Each may be missing.
struct ByChangedArrays {
  static constexpr char kName[] = "ByChangedArrays";
  static constexpr const char* kFields[] = {"sh",     "offset",  "color", "opacity", "feature_color", "feature_opacity",
                                            "linear", "features"};
  MaybeIn<-1, 1, 3> sh;
  MaybeIn<-1, 3> offset, color;
  MaybeIn<-1> opacity;
  MaybeIn<-1, 3> feature_color;
  MaybeIn<-1> feature_opacity;
  MaybeIn<> linear, features;

  ByChangedArrays(const Group<ByChangedArrays>& group, size_t count) {
    group.read(sh, offset, color, opacity, feature_color, feature_opacity, linear, features);
    require(fits(sh, count) && fits(offset, count) && fits(color, count) && fits(opacity, count) &&
                fits(feature_color, count) && fits(feature_opacity, count),
            "a gradient must have one row per Gaussian");
  }
  mien::GaussianChanges<const float> changes() const { return changes_of<const float>(*this); }

 private:
  template <typename A>
  static bool fits(const std::optional<A>& gradient, size_t count) {
    return !gradient || gradient->shape(0) == count;
  }
};

// The gradients of bases, features and layers, as far as `ChangeArrays` has them.
struct ChangeGradientArrays {
  static constexpr char kName[] = "ChangeGradients";
  static constexpr const char* kFields[] = {"offset_basis", "color_basis", "opacity_basis",
                                            "features",     "weight1",     "weight2"};
  MaybeOut<-1, 3, -1> offset_basis, color_basis;
  MaybeOut<-1, -1> opacity_basis, features, weight1, weight2;

  ChangeGradientArrays(const Group<ChangeGradientArrays>& group, const ChangeArrays& own) {
    group.read(offset_basis, color_basis, opacity_basis, features, weight1, weight2);
    require(same(offset_basis, own.offset_basis) && same(color_basis, own.color_basis) &&
                same(opacity_basis, own.opacity_basis) && same(features, own.neutral) && same(weight1, own.weight1) &&
                same(weight2, own.weight2),
            "a gradient must have the shape of its array");
  }

 private:
  template <typename A, typename B>
  static bool same(const std::optional<A>& gradient, const std::optional<B>& array) {
    return gradient.has_value() == array.has_value() && (!gradient || same_shape(*gradient, *array));
  }
};
