// Posing a face, forward and backward, for models of odd sizes.
#include "checks.h"
#include "face.h"
#include "pool.h"

namespace checks {
namespace {

struct Result {
  Floats shaped, vertices, rest, joint_rest, expression, joints, rotation, translation;
  bool operator==(const Result&) const = default;
};

struct Sizes {
  int vertices, expressions, free_joints;
  bool correctives;
};

mien::FaceModelData random_model(const Sizes& sizes, Random& random) {
  const int v = sizes.vertices, e = sizes.expressions, k = sizes.free_joints + 1;  // the first joint is not free
  mien::FaceModelData model;
  model.vertices = v, model.expressions = e, model.joints = k, model.free_joints = sizes.free_joints;
  for (int joint = 0; joint < k; ++joint) {
    model.parents.push_back(joint == 0 ? -1 : static_cast<int>(random.below(joint)));
    model.free_index.push_back(joint - 1);
  }
  model.joint_rotation_basis = random.normal(3 * e * k, 0.1f);
  model.joint_translation_basis = random.normal(3 * e * k, 0.01f);
  Floats basis = random.normal(3 * e * v, 0.01f), correctives = random.normal(27 * sizes.free_joints * v, 0.01f);
  for (size_t i = 0; i < basis.size(); ++i) basis[i] *= (i / 50) % 2;  // most blendshapes move only some vertices
  Floats weights = random.uniform(v * k);
  for (float& weight : weights) weight = weight < 0.5f ? 0 : weight / k;
  return mien::make_face_model(std::move(model), basis.data(), sizes.correctives ? correctives.data() : nullptr,
                               weights.data());
}

Result pose(const Sizes& sizes, bool in_world) {
  Random random(11);
  const mien::FaceModelData model = random_model(sizes, random);
  const int v = sizes.vertices, e = sizes.expressions, j = sizes.free_joints, k = j + 1;
  const Floats rest = random.normal(3 * v), joint_rest = random.normal(3 * k), expression = random.uniform(e);
  const Floats joints = random.normal(3 * j), rotation = random.normal(3), translation = random.normal(3);
  const mien::FacePose task{rest.data(),
                            joint_rest.data(),
                            expression.data(),
                            joints.data(),
                            in_world ? rotation.data() : nullptr,
                            in_world ? translation.data() : nullptr};
  Result r{Floats(3 * v), Floats(3 * v), Floats(3 * v), Floats(3 * k), Floats(e), Floats(3 * j), Floats(3), Floats(3)};
  mien::pose_face(model, task, r.shaped.data(), r.vertices.data());
  const Floats gradient = random.normal(3 * v);
  mien::pose_face_backward(model, task, r.shaped.data(), gradient.data(),
                           {r.rest.data(), r.joint_rest.data(), r.expression.data(), r.joints.data(), r.rotation.data(),
                            r.translation.data()});
  return r;
}

void check_head_poses() {
  Random random(13);
  for (float size : {0.0f, 1e-20f, 1e-4f, 1.0f, 40.0f}) {
    const Floats rotation = random.normal(3, size), translation = random.normal(3), gradient = random.normal(16);
    Floats transform(16), grad_rotation(3);
    mien::head_pose(rotation.data(), translation.data(), transform.data());
    mien::head_pose_backward(rotation.data(), gradient.data(), grad_rotation.data());
    CHECK(all_finite(transform) && all_finite(grad_rotation));
    for (int row = 0; row < 3; ++row) {
      CHECK(transform[4 * row + 3] == translation[row]);
      float squares = 0;
      for (int column = 0; column < 3; ++column) squares += transform[4 * row + column] * transform[4 * row + column];
      CHECK(std::fabs(squares - 1) < 1e-5f);
    }
  }
}

}  // namespace

void check_face() {
  check_head_poses();
  for (const Sizes& sizes : {Sizes{1, 1, 0, false},
                             {15, 2, 1, true},
                             {16, 3, 2, true},
                             {17, 0, 2, false},
                             {333, 20, 3, true},
                             {1000, 52, 3, false}}) {
    for (bool in_world : {false, true}) {
      mien::set_thread_count(1);
      const Result serial = pose(sizes, in_world);
      CHECK(all_finite(serial.vertices) && all_finite(serial.expression) && all_finite(serial.rotation));
      mien::set_thread_count(3);
      CHECK(pose(sizes, in_world) == serial);
    }
  }
}

}  // namespace checks
