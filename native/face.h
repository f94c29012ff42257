// A posed face: blendshapes, joints and linear blend skinning; src/mien/face/model.py has the same in plain PyTorch.
#pragma once

#include <cstdint>
#include <vector>

namespace mien {

constexpr int kFaceBlock = 16;                    // vertices that share a list of blendshapes
constexpr int kFaceBlockFloats = 3 * kFaceBlock;  // x y z x y z ...
constexpr int kMostFaceShapes = 256;
constexpr int kMostFaceVertices = 1 << 24;
constexpr int kMostFaceJoints = 127;  // joints of all vertices are listed with 32-bit numbers
constexpr int kFaceParts = 4;         // parts of the vertices: sums run part by part, whichever thread computes which

// A model's constants. Most blendshapes move a sixth of the vertices: only blocks with a motion are kept.
struct FaceModelData {
  int vertices = 0, expressions = 0, joints = 0, free_joints = 0;
  int shapes = 0;                           // blendshapes: the expressions, then 9 pose correctives a free joint if any
  std::vector<int32_t> block_begins;        // [blocks + 1] into the two below
  std::vector<int32_t> block_shapes;        // which blendshape
  std::vector<float> block_motions;         // [.., kFaceBlockFloats]
  std::vector<float> joint_rotation_basis;  // [e, k, 3]
  std::vector<float> joint_translation_basis;
  std::vector<int32_t> skin_begins;  // [v + 1] into the two below
  std::vector<int32_t> skin_joints;
  std::vector<float> skin_weights;  // positive
  std::vector<int32_t> parents;     // [k], -1 for none
  std::vector<int32_t> free_index;  // [k], row of the joint's free rotation or -1

  int blocks() const { return (vertices + kFaceBlock - 1) / kFaceBlock; }
};

// Dense arrays as a FaceModel has them; `pose_basis` [9 * free joints, v, 3] may be null.
FaceModelData make_face_model(FaceModelData sizes, const float* expression_basis, const float* pose_basis,
                              const float* skinning_weights);

// One timestep.
struct FacePose {
  const float* rest;              // [v,3], this person without expression
  const float* joint_rest;        // [k,3]
  const float* expression;        // [e]
  const float* joints;            // [free joints, 3], axis-angle
  const float* head_rotation;     // [3], or null: vertices stay in the head frame
  const float* head_translation;  // [3]
};

struct FaceGradients {
  float* rest;  // all written; the last two only if the pose has a head
  float* joint_rest;
  float* expression;
  float* joints;
  float* head_rotation;
  float* head_translation;
};

// T_world_head [4,4], row-major, of an axis-angle and a translation: the head frame of `pose_face`, to the bit. And
// back: d loss / d axis-angle, from the whole gradient's rotation.
void head_pose(const float* rotation, const float* translation, float* transform);
void head_pose_backward(const float* rotation, const float* grad_transform, float* grad_rotation);

// Fills `vertices` [v,3] and `shaped` [v,3], the vertices before the joints, which the backward pass reads.
void pose_face(const FaceModelData& model, const FacePose& pose, float* shaped, float* vertices);
void pose_face_backward(const FaceModelData& model, const FacePose& pose, const float* shaped,
                        const float* grad_vertices, const FaceGradients& gradients);

}  // namespace mien
