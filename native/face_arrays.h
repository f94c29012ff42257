// The arrays of a face as Python passes them, which bind_face.cpp and bind_ride.cpp read.
#pragma once

#include <nanobind/stl/optional.h>

#include <optional>

#include "arrays.h"
#include "face.h"

struct FaceArrayNames {
  static constexpr char kName[] = "FaceArrays";
  static constexpr const char* kFields[] = {"rest",   "joint_rest",    "expression",
                                            "joints", "head_rotation", "head_translation"};
};

// Parameters of b timesteps, and the person's shape. Without a head, vertices stay in the head frame.
struct FaceArrays : FaceArrayNames {
  In<-1, 3> rest, joint_rest;
  In<-1, -1> expression;
  In<-1, -1, 3> joints;
  std::optional<In<-1, 3>> head_rotation, head_translation;

  FaceArrays(const mien::FaceModelData& model, const Group<FaceArrays>& group) {
    group.read(rest, joint_rest, expression, joints, head_rotation, head_translation);
    const size_t b = size();
    require(rest.shape(0) == static_cast<size_t>(model.vertices) &&
                joint_rest.shape(0) == static_cast<size_t>(model.joints) &&
                expression.shape(1) == static_cast<size_t>(model.expressions) && joints.shape(0) == b &&
                joints.shape(1) == static_cast<size_t>(model.free_joints) &&
                head_rotation.has_value() == head_translation.has_value() &&
                (!head_rotation || (head_rotation->shape(0) == b && head_translation->shape(0) == b)),
            "the arrays do not fit the face model");
  }

  size_t size() const { return expression.shape(0); }
  mien::FacePose pose(size_t b) const {
    return {rest.data(),
            joint_rest.data(),
            expression.data() + b * expression.shape(1),
            joints.data() + b * 3 * joints.shape(1),
            head_rotation ? head_rotation->data() + 3 * b : nullptr,
            head_translation ? head_translation->data() + 3 * b : nullptr};
  }
};
