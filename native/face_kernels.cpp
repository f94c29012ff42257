// Compiled once per instruction set: blendshapes a block of vertices at a time, then skinning vertex by vertex.
#include "face_kernels.h"

#include "simd.h"

namespace mien::MIEN_ISA {
namespace {

constexpr int VECTORS = kFaceBlockFloats / W;

// Copies a block's rows of a [v,3] array; zeros beyond its end.
MIEN_INLINE int valid_floats(const FaceShapes& model, int block) {
  const int left = 3 * model.vertices - block * kFaceBlockFloats;
  return left < kFaceBlockFloats ? left : kFaceBlockFloats;
}

MIEN_INLINE void apply(const RigidTransform& a, const float* p, float* out) {
  for (int row = 0; row < 3; ++row)
    out[row] = a.R[3 * row] * p[0] + a.R[3 * row + 1] * p[1] + a.R[3 * row + 2] * p[2] + a.t[row];
}
MIEN_INLINE void rotate_back(const float* R, const float* g, float* out) {
  for (int column = 0; column < 3; ++column)
    out[column] = R[column] * g[0] + R[3 + column] * g[1] + R[6 + column] * g[2];
}
MIEN_INLINE void add_outer(RigidTransform& sum, const float* g, const float* p, float weight) {
  for (int row = 0; row < 3; ++row) {
    const float scaled = weight * g[row];
    for (int column = 0; column < 3; ++column) sum.R[3 * row + column] += scaled * p[column];
    sum.t[row] += scaled;
  }
}

MIEN_INLINE RigidTransform blended(const FaceShapes& model, const RigidTransform* joints, int vertex) {
  const int begin = model.skin_begins[vertex], end = model.skin_begins[vertex + 1];
  RigidTransform sum{};
  for (int i = begin; i < end; ++i) {
    const RigidTransform& joint = joints[model.skin_joints[i]];
    for (int j = 0; j < 9; ++j) sum.R[j] += model.skin_weights[i] * joint.R[j];
    for (int j = 0; j < 3; ++j) sum.t[j] += model.skin_weights[i] * joint.t[j];
  }
  return sum;
}

void pose(const FaceShapes& model, const float* rest, const float* coefficients, const RigidTransform* joints,
          const RigidTransform* head, int first, int last, float* shaped, float* vertices) {
  for (int block = first; block < last; ++block) {
    const int valid = valid_floats(model, block);
    const int64_t from = (int64_t)block * kFaceBlockFloats;
    alignas(64) float values[kFaceBlockFloats] = {};
    memcpy(values, rest + from, sizeof(float) * valid);
    F sums[VECTORS];
    for (int v = 0; v < VECTORS; ++v) sums[v] = load(values + v * W);
    for (int i = model.block_begins[block]; i < model.block_begins[block + 1]; ++i) {
      const float coefficient = coefficients[model.block_shapes[i]];
      const float* motion = model.block_motions + (int64_t)i * kFaceBlockFloats;
      for (int v = 0; v < VECTORS; ++v) sums[v] = sums[v] + load(motion + v * W) * coefficient;
    }
    for (int v = 0; v < VECTORS; ++v) store(values + v * W, sums[v]);
    memcpy(shaped + from, values, sizeof(float) * valid);
    for (int i = 0; i < valid; i += 3) {
      float in_head[3];
      apply(blended(model, joints, block * kFaceBlock + i / 3), values + i, in_head);
      if (head) {
        apply(*head, in_head, vertices + from + i);
      } else {
        memcpy(vertices + from + i, in_head, sizeof in_head);
      }
    }
  }
}

void backward(const FaceShapes& model, const float* shaped, const RigidTransform* joints, const RigidTransform* head,
              const float* grad_vertices, int first, int last, float* grad_rest, const FaceSums& sums) {
  F by_shape[kMostFaceShapes];
  for (int shape = 0; shape < model.shapes; ++shape) by_shape[shape] = F{};
  for (int block = first; block < last; ++block) {
    const int valid = valid_floats(model, block);
    const int64_t from = (int64_t)block * kFaceBlockFloats;
    alignas(64) float gradient[kFaceBlockFloats] = {};
    for (int i = 0; i < valid; i += 3) {
      const int vertex = block * kFaceBlock + i / 3;
      const float *p = shaped + from + i, *g = grad_vertices + from + i;
      const RigidTransform blend = blended(model, joints, vertex);
      float in_frame[3];
      if (head) {
        float in_head[3];
        apply(blend, p, in_head);
        add_outer(*sums.head, g, in_head, 1.0f);
        rotate_back(head->R, g, in_frame);
      } else {
        memcpy(in_frame, g, sizeof in_frame);
      }
      for (int j = model.skin_begins[vertex]; j < model.skin_begins[vertex + 1]; ++j)
        add_outer(sums.transforms[model.skin_joints[j]], in_frame, p, model.skin_weights[j]);
      rotate_back(blend.R, in_frame, gradient + i);
    }
    memcpy(grad_rest + from, gradient, sizeof(float) * valid);
    F g[VECTORS];
    for (int v = 0; v < VECTORS; ++v) g[v] = load(gradient + v * W);
    for (int i = model.block_begins[block]; i < model.block_begins[block + 1]; ++i) {
      const float* motion = model.block_motions + (int64_t)i * kFaceBlockFloats;
      F total = by_shape[model.block_shapes[i]];
      for (int v = 0; v < VECTORS; ++v) total = total + load(motion + v * W) * g[v];
      by_shape[model.block_shapes[i]] = total;
    }
  }
  for (int shape = 0; shape < model.shapes; ++shape) sums.shapes[shape] = sum(by_shape[shape]);
}

}  // namespace

extern const FaceKernels face_kernels;
const FaceKernels face_kernels = {pose, backward};

}  // namespace mien::MIEN_ISA
