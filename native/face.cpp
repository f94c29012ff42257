#include "face.h"

#include <algorithm>
#include <cmath>

#include "face_kernels.h"
#include "isa.h"
#include "pool.h"

namespace mien {

MIEN_CHOOSE_KERNELS(FaceKernels, face_kernels)

namespace {

// Rodrigues' formula R = I + s K + c K^2 with q = angle^2, s = sin / angle, c = (1 - cos) / q, in double precision.
struct Rodrigues {
  double a[3], s, c, ds, dc;  // ds, dc: derivatives with respect to q

  explicit Rodrigues(const float* axis_angle) {
    for (int i = 0; i < 3; ++i) a[i] = axis_angle[i];
    const double q = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
    if (q < 1e-4) {
      s = 1 - q / 6 * (1 - q / 20), c = 0.5 - q / 24 * (1 - q / 30);
      ds = -1.0 / 6 + q / 60, dc = -1.0 / 24 + q / 360;
    } else {
      const double angle = std::sqrt(q);
      s = std::sin(angle) / angle, c = (1 - std::cos(angle)) / q;
      ds = (std::cos(angle) - s) / (2 * q), dc = (s / 2 - c) / q;
    }
  }

  // K^2 = a a^T - q I.
  double square(int row, int column) const {
    return a[row] * a[column] - (row == column ? a[0] * a[0] + a[1] * a[1] + a[2] * a[2] : 0);
  }
  double skew(int row, int column) const {
    if (row == column) return 0;
    const int other = 3 - row - column;
    return (column == (row + 1) % 3 ? -1 : 1) * a[other];
  }

  void matrix(float* R) const {
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) {
        R[3 * row + column] =
            static_cast<float>((row == column ? 1.0 : 0.0) + s * skew(row, column) + c * square(row, column));
      }
    }
  }

  // d loss / d axis-angle from d loss / d R.
  void backward(const float* dR, float* out) const {
    double along_skew = 0, along_square = 0, trace = 0;
    double by_a[3] = {};
    for (int row = 0; row < 3; ++row) {
      trace += dR[4 * row];
      for (int column = 0; column < 3; ++column) {
        const double d = dR[3 * row + column];
        along_skew += d * skew(row, column);
        along_square += d * square(row, column);
        by_a[row] += c * d * a[column];
        by_a[column] += c * d * a[row];
      }
    }
    const double turn[3] = {dR[7] - dR[5], dR[2] - dR[6], dR[3] - dR[1]};
    for (int i = 0; i < 3; ++i) {
      const double by_q = along_skew * ds + along_square * dc - c * trace;
      out[i] = static_cast<float>(by_a[i] + s * turn[i] + 2 * a[i] * by_q);
    }
  }
};

RigidTransform compose(const RigidTransform& a, const RigidTransform& b) {
  RigidTransform out;
  for (int row = 0; row < 3; ++row) {
    out.t[row] = a.t[row];
    for (int column = 0; column < 3; ++column) {
      out.R[3 * row + column] = 0;
      for (int k = 0; k < 3; ++k) out.R[3 * row + column] += a.R[3 * row + k] * b.R[3 * k + column];
      out.t[row] += a.R[3 * row + column] * b.t[column];
    }
  }
  return out;
}

// Adds the gradient of a composition to the gradients of a and b.
void compose_backward(const RigidTransform& a, const RigidTransform& b, const RigidTransform& gradient,
                      RigidTransform& grad_a, RigidTransform& grad_b) {
  for (int row = 0; row < 3; ++row) {
    grad_a.t[row] += gradient.t[row];
    for (int k = 0; k < 3; ++k) {
      grad_a.R[3 * row + k] += gradient.t[row] * b.t[k];
      grad_b.t[k] += a.R[3 * row + k] * gradient.t[row];
      for (int column = 0; column < 3; ++column) {
        grad_a.R[3 * row + k] += gradient.R[3 * row + column] * b.R[3 * k + column];
        grad_b.R[3 * k + column] += a.R[3 * row + k] * gradient.R[3 * row + column];
      }
    }
  }
}

// The small quantities of one timestep: the joints' rotations, alone and along the chain from the head.
struct Skeleton {
  std::vector<float> coefficients;  // [shapes]
  std::vector<float> turns;         // [k, 3] axis-angle
  std::vector<float> shifts;        // [k, 3] joint_rest + shift
  std::vector<RigidTransform> local, chained;
  RigidTransform head;

  Skeleton(const FaceModelData& model, const FacePose& pose)
      : coefficients(model.shapes),
        turns(3 * model.joints),
        shifts(3 * model.joints),
        local(model.joints),
        chained(model.joints) {
    std::copy(pose.expression, pose.expression + model.expressions, coefficients.begin());
    for (int j = 0; j < 3 * model.joints; ++j) {
      double turn = 0, shift = pose.joint_rest[j];
      for (int e = 0; e < model.expressions; ++e) {
        const double coefficient = pose.expression[e];
        turn += coefficient * model.joint_rotation_basis[e * 3 * model.joints + j];
        shift += coefficient * model.joint_translation_basis[e * 3 * model.joints + j];
      }
      const int row = model.free_index[j / 3];
      turns[j] = row >= 0 ? pose.joints[3 * row + j % 3] : static_cast<float>(turn);
      shifts[j] = static_cast<float>(shift);
    }
    for (int joint = 0; joint < model.joints; ++joint) {
      RigidTransform& own = local[joint];
      Rodrigues(&turns[3 * joint]).matrix(own.R);
      // About the joint: x -> R (x - rest) + rest + shift.
      const float* rest = pose.joint_rest + 3 * joint;
      for (int row = 0; row < 3; ++row) {
        const float* R = own.R + 3 * row;
        own.t[row] = shifts[3 * joint + row] - (R[0] * rest[0] + R[1] * rest[1] + R[2] * rest[2]);
      }
      const int parent = model.parents[joint], row = model.free_index[joint];
      chained[joint] = parent < 0 ? own : compose(chained[parent], own);
      if (row < 0 || model.shapes == model.expressions) continue;
      for (int i = 0; i < 9; ++i) coefficients[model.expressions + 9 * row + i] = own.R[i] - (i % 4 == 0 ? 1.0f : 0.0f);
    }
    if (!pose.head_rotation) return;
    Rodrigues(pose.head_rotation).matrix(head.R);
    std::copy(pose.head_translation, pose.head_translation + 3, head.t);
  }
};

FaceShapes shapes_of(const FaceModelData& model) {
  return {model.vertices,
          model.shapes,
          model.block_begins.data(),
          model.block_shapes.data(),
          model.block_motions.data(),
          model.skin_begins.data(),
          model.skin_joints.data(),
          model.skin_weights.data()};
}

int part_begin(const FaceModelData& model, int64_t part) {
  return static_cast<int>(model.blocks() * part / kFaceParts);
}

// Computes the gradients of the pose from the sums over vertices.
void skeleton_backward(const FaceModelData& model, const FacePose& pose, const Skeleton& skeleton, const FaceSums& sums,
                       const FaceGradients& out) {
  std::copy(sums.shapes, sums.shapes + model.expressions, out.expression);
  std::vector<RigidTransform> by_local(model.joints);
  for (int joint = model.joints - 1; joint >= 0; --joint) {
    const int parent = model.parents[joint], row = model.free_index[joint];
    RigidTransform& g = by_local[joint];
    if (parent < 0) {
      g = sums.transforms[joint];
    } else {
      compose_backward(skeleton.chained[parent], skeleton.local[joint], sums.transforms[joint], sums.transforms[parent],
                       g);
    }
    const float* rest = pose.joint_rest + 3 * joint;
    for (int i = 0; i < 3; ++i) {
      float by_rest = g.t[i];
      for (int k = 0; k < 3; ++k) {
        by_rest -= skeleton.local[joint].R[3 * k + i] * g.t[k];
        g.R[3 * i + k] -= g.t[i] * rest[k];
      }
      out.joint_rest[3 * joint + i] = by_rest;
    }
    if (row >= 0 && model.shapes > model.expressions) {
      for (int i = 0; i < 9; ++i) g.R[i] += sums.shapes[model.expressions + 9 * row + i];
    }
    float turn[3];
    Rodrigues(&skeleton.turns[3 * joint]).backward(g.R, turn);
    if (row >= 0) std::copy(turn, turn + 3, out.joints + 3 * row);
    for (int e = 0; e < model.expressions; ++e) {
      const int64_t from = static_cast<int64_t>(e) * 3 * model.joints + 3 * joint;
      for (int i = 0; i < 3; ++i) {
        out.expression[e] += g.t[i] * model.joint_translation_basis[from + i];
        if (row < 0) out.expression[e] += turn[i] * model.joint_rotation_basis[from + i];
      }
    }
  }
  if (!pose.head_rotation) return;
  Rodrigues(pose.head_rotation).backward(sums.head->R, out.head_rotation);
  std::copy(sums.head->t, sums.head->t + 3, out.head_translation);
}

void add(RigidTransform& sum, const RigidTransform& other) {
  for (int i = 0; i < 9; ++i) sum.R[i] += other.R[i];
  for (int i = 0; i < 3; ++i) sum.t[i] += other.t[i];
}

}  // namespace

FaceModelData make_face_model(FaceModelData model, const float* expression_basis, const float* pose_basis,
                              const float* skinning_weights) {
  model.shapes = model.expressions + (pose_basis ? 9 * model.free_joints : 0);
  const int64_t row = 3 * static_cast<int64_t>(model.vertices);
  for (int block = 0; block < model.blocks(); ++block) {
    model.block_begins.push_back(static_cast<int32_t>(model.block_shapes.size()));
    const int64_t from = static_cast<int64_t>(block) * kFaceBlockFloats;
    const int64_t valid = std::min<int64_t>(kFaceBlockFloats, row - from);
    for (int shape = 0; shape < model.shapes; ++shape) {
      const float* motion =
          shape < model.expressions ? expression_basis + shape * row : pose_basis + (shape - model.expressions) * row;
      if (std::all_of(motion + from, motion + from + valid, [](float value) { return value == 0; })) continue;
      model.block_shapes.push_back(shape);
      model.block_motions.insert(model.block_motions.end(), motion + from, motion + from + valid);
      model.block_motions.resize(model.block_shapes.size() * kFaceBlockFloats);
    }
  }
  model.block_begins.push_back(static_cast<int32_t>(model.block_shapes.size()));
  for (int vertex = 0; vertex < model.vertices; ++vertex) {
    model.skin_begins.push_back(static_cast<int32_t>(model.skin_joints.size()));
    for (int joint = 0; joint < model.joints; ++joint) {
      const float weight = skinning_weights[static_cast<int64_t>(vertex) * model.joints + joint];
      if (weight == 0) continue;
      model.skin_joints.push_back(joint);
      model.skin_weights.push_back(weight);
    }
  }
  model.skin_begins.push_back(static_cast<int32_t>(model.skin_joints.size()));
  return model;
}

void head_pose(const float* rotation, const float* translation, float* transform) {
  float R[9];
  Rodrigues(rotation).matrix(R);
  for (int row = 0; row < 3; ++row) {
    std::copy(R + 3 * row, R + 3 * row + 3, transform + 4 * row);
    transform[4 * row + 3] = translation[row];
    transform[12 + row] = 0;
  }
  transform[15] = 1;
}

void head_pose_backward(const float* rotation, const float* grad_transform, float* grad_rotation) {
  float by_R[9];
  for (int i = 0; i < 9; ++i) by_R[i] = grad_transform[4 * (i / 3) + i % 3];
  Rodrigues(rotation).backward(by_R, grad_rotation);
}

void pose_face(const FaceModelData& model, const FacePose& pose, float* shaped, float* vertices) {
  const Skeleton skeleton(model, pose);
  const RigidTransform* head = pose.head_rotation ? &skeleton.head : nullptr;
  const FaceKernels& kernels = face_kernels();
  const FaceShapes shapes = shapes_of(model);
  parallel_for(kFaceParts, [&](int64_t part) {
    kernels.pose(shapes, pose.rest, skeleton.coefficients.data(), skeleton.chained.data(), head,
                 part_begin(model, part), part_begin(model, part + 1), shaped, vertices);
  });
}

void pose_face_backward(const FaceModelData& model, const FacePose& pose, const float* shaped,
                        const float* grad_vertices, const FaceGradients& gradients) {
  const Skeleton skeleton(model, pose);
  const RigidTransform* head = pose.head_rotation ? &skeleton.head : nullptr;
  const FaceKernels& kernels = face_kernels();
  const FaceShapes shapes = shapes_of(model);
  const int k = model.joints;
  std::vector<float> by_shape(kFaceParts * model.shapes);
  std::vector<RigidTransform> by_joint(kFaceParts * (k + 1));  // the last of each part is the head
  const auto sums = [&](int64_t part) {
    RigidTransform* first = by_joint.data() + part * (k + 1);
    return FaceSums{by_shape.data() + part * model.shapes, first, first + k};
  };
  parallel_for(kFaceParts, [&](int64_t part) {
    kernels.backward(shapes, shaped, skeleton.chained.data(), head, grad_vertices, part_begin(model, part),
                     part_begin(model, part + 1), gradients.rest, sums(part));
  });
  for (int part = 1; part < kFaceParts; ++part) {
    for (int shape = 0; shape < model.shapes; ++shape) by_shape[shape] += by_shape[part * model.shapes + shape];
    for (int joint = 0; joint <= k; ++joint) add(by_joint[joint], by_joint[part * (k + 1) + joint]);
  }
  skeleton_backward(model, pose, skeleton, sums(0), gradients);
}

}  // namespace mien
