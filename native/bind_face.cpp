#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <vector>

#include "arrays.h"
#include "face.h"
#include "face_arrays.h"
#include "pool.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

mien::FaceModelData make_model(const In<-1, -1, 3>& expression_basis, const std::optional<In<-1, -1, 3>>& pose_basis,
                               const In<-1, -1, 3>& rotation_basis, const In<-1, -1, 3>& translation_basis,
                               const In<-1, -1>& skinning_weights, const std::vector<int>& parents,
                               const std::vector<bool>& is_free) {
  mien::FaceModelData sizes;
  sizes.vertices = checked_length(skinning_weights.shape(0), mien::kMostFaceVertices, "vertices");
  sizes.expressions = checked_length(expression_basis.shape(0), mien::kMostFaceShapes, "blendshapes");
  sizes.joints = checked_length(skinning_weights.shape(1), mien::kMostFaceJoints, "joints");
  const size_t e = expression_basis.shape(0), v = skinning_weights.shape(0), k = skinning_weights.shape(1);
  require(expression_basis.shape(1) == v && rotation_basis.shape(0) == e && rotation_basis.shape(1) == k &&
              translation_basis.shape(0) == e && translation_basis.shape(1) == k && parents.size() == k &&
              is_free.size() == k,
          "the arrays of a face model do not belong together");
  for (size_t joint = 0; joint < k; ++joint) {
    require(parents[joint] >= -1 && parents[joint] < static_cast<int>(joint), "a joint must come after its parent");
    sizes.parents.push_back(parents[joint]);
    sizes.free_index.push_back(is_free[joint] ? sizes.free_joints++ : -1);
  }
  require(
      !pose_basis || (pose_basis->shape(0) == 9 * static_cast<size_t>(sizes.free_joints) && pose_basis->shape(1) == v),
      "the pose basis must have 9 shapes per free joint");
  checked_length(e + 9 * static_cast<size_t>(sizes.free_joints), mien::kMostFaceShapes, "blendshapes");
  sizes.joint_rotation_basis.assign(rotation_basis.data(), rotation_basis.data() + rotation_basis.size());
  sizes.joint_translation_basis.assign(translation_basis.data(), translation_basis.data() + translation_basis.size());
  return mien::make_face_model(std::move(sizes), expression_basis.data(), pose_basis ? pose_basis->data() : nullptr,
                               skinning_weights.data());
}

void forward(const mien::FaceModelData& model, const Group<FaceArrays>& group, const Out<-1, -1, 3>& shaped,
             const Out<-1, -1, 3>& vertices) {
  const FaceArrays face(model, group);
  const size_t floats = 3 * static_cast<size_t>(model.vertices);
  require(has_shape(shaped, face.size(), model.vertices, 3) && same_shape(vertices, shaped),
          "the outputs do not have the size of the inputs");
  const nb::gil_scoped_release release;
  mien::parallel_for(static_cast<int64_t>(face.size()), [&](int64_t b) {
    mien::pose_face(model, face.pose(b), shaped.data() + b * floats, vertices.data() + b * floats);
  });
}

// Gradients of b timesteps, one of each per timestep.
struct FaceGradientArrays : FaceArrayNames {
  Out<-1, -1, 3> rest, joint_rest;
  Out<-1, -1> expression;
  Out<-1, -1, 3> joints;
  Out<-1, 3> head_rotation, head_translation;

  explicit FaceGradientArrays(const Group<FaceGradientArrays>& group) {
    group.read(rest, joint_rest, expression, joints, head_rotation, head_translation);
  }
  mien::FaceGradients of(size_t b) const {
    return {rest.data() + b * 3 * rest.shape(1),
            joint_rest.data() + b * 3 * joint_rest.shape(1),
            expression.data() + b * expression.shape(1),
            joints.data() + b * 3 * joints.shape(1),
            head_rotation.data() + 3 * b,
            head_translation.data() + 3 * b};
  }
};

void backward(const mien::FaceModelData& model, const Group<FaceArrays>& group, const In<-1, -1, 3>& shaped,
              const In<-1, -1, 3>& grad_vertices, const Group<FaceGradientArrays>& gradient_group) {
  const FaceArrays face(model, group);
  const FaceGradientArrays gradients(gradient_group);
  const size_t b = face.size(), floats = 3 * static_cast<size_t>(model.vertices);
  require(has_shape(shaped, b, model.vertices, 3) && same_shape(grad_vertices, shaped) &&
              same_shape(gradients.rest, shaped) && has_shape(gradients.joint_rest, b, model.joints, 3) &&
              same_shape(gradients.expression, face.expression) && same_shape(gradients.joints, face.joints) &&
              has_shape(gradients.head_rotation, b, 3) && has_shape(gradients.head_translation, b, 3),
          "a gradient must have the shape of its array");
  const nb::gil_scoped_release release;
  mien::parallel_for(static_cast<int64_t>(b), [&](int64_t i) {
    mien::pose_face_backward(model, face.pose(i), shaped.data() + i * floats, grad_vertices.data() + i * floats,
                             gradients.of(i));
  });
}

void head_poses(const In<-1, 3>& rotation, const In<-1, 3>& translation, const Out<-1, 4, 4>& transforms) {
  const size_t b = rotation.shape(0);
  require(translation.shape(0) == b && transforms.shape(0) == b, "head poses of different numbers");
  for (size_t i = 0; i < b; ++i)
    mien::head_pose(rotation.data() + 3 * i, translation.data() + 3 * i, transforms.data() + 16 * i);
}

void head_poses_backward(const In<-1, 3>& rotation, const In<-1, 4, 4>& grad_transforms,
                         const Out<-1, 3>& grad_rotation) {
  const size_t b = rotation.shape(0);
  require(grad_transforms.shape(0) == b && grad_rotation.shape(0) == b, "head poses of different numbers");
  for (size_t i = 0; i < b; ++i)
    mien::head_pose_backward(rotation.data() + 3 * i, grad_transforms.data() + 16 * i, grad_rotation.data() + 3 * i);
}

using Matrix = In<4, 4>;

// first . second, added up from the first column to the last.
void compose_rigid(const Matrix& first, const Matrix& second, const Out<4, 4>& out) {
  const float *a = first.data(), *b = second.data();
  for (int row = 0; row < 4; ++row) {
    for (int column = 0; column < 4; ++column) {
      float sum = a[4 * row] * b[column];
      for (int k = 1; k < 4; ++k) sum += a[4 * row + k] * b[4 * k + column];
      out.data()[4 * row + column] = sum;
    }
  }
}

void compose_rigid_backward(const Matrix& first, const Matrix& second, const Matrix& gradient,
                            const Out<4, 4>& grad_first, const Out<4, 4>& grad_second) {
  const float *a = first.data(), *b = second.data(), *g = gradient.data();
  for (int row = 0; row < 4; ++row) {
    for (int column = 0; column < 4; ++column) {
      float by_first = 0, by_second = 0;
      for (int k = 0; k < 4; ++k) {
        by_first += g[4 * row + k] * b[4 * column + k];
        by_second += a[4 * k + row] * g[4 * k + column];
      }
      grad_first.data()[4 * row + column] = by_first;
      grad_second.data()[4 * row + column] = by_second;
    }
  }
}

}  // namespace

void bind_face(nb::module_& module) {
  nb::class_<mien::FaceModelData>(module, "FaceModelData", "A face model's constants, compressed.");
  module.def("make_face_model", &make_model, "expression_basis"_a, "pose_basis"_a.none(), "rotation_basis"_a,
             "translation_basis"_a, "skinning_weights"_a, "parents"_a, "is_free"_a);
  bind_group<FaceArrays>(module);
  module.def("pose_face", &forward, "model"_a, "face"_a, "shaped"_a, "vertices"_a,
             "Fills the vertices of b timesteps, and those before the joints.");
  module.def("pose_face_backward", &backward, "model"_a, "face"_a, "shaped"_a, "grad_vertices"_a, "gradients"_a,
             "Fills the gradients, one of each per timestep.");
  module.def("head_poses", &head_poses, "rotation"_a.noconvert(), "translation"_a.noconvert(),
             "transforms"_a.noconvert(), "Fills T_world_head of b timesteps.");
  module.def("compose_rigid", &compose_rigid, "first"_a, "second"_a, "out"_a);
  module.def("compose_rigid_backward", &compose_rigid_backward, "first"_a, "second"_a, "gradient"_a, "grad_first"_a,
             "grad_second"_a);
  module.def("head_poses_backward", &head_poses_backward, "rotation"_a.noconvert(), "grad_transforms"_a.noconvert(),
             "grad_rotation"_a.noconvert());
}
