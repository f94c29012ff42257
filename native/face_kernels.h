// What face.cpp hands to its kernels, which are compiled once per instruction set.
#pragma once

#include "face.h"

namespace mien {

struct RigidTransform {
  float R[9];  // row-major
  float t[3];
};

// What kernels read of a FaceModelData: plain pointers, since no code of std templates may be compiled per instruction
// set.
struct FaceShapes {
  int vertices, shapes;
  const int32_t *block_begins, *block_shapes;
  const float* block_motions;
  const int32_t *skin_begins, *skin_joints;
  const float* skin_weights;
};

// Of one part of the vertices: sums over them.
struct FaceSums {
  float* shapes;               // [shapes] d loss / d coefficient
  RigidTransform* transforms;  // [k] d loss / d joint transform
  RigidTransform* head;
};

struct FaceKernels {
  // Vertices of blocks first .. last - 1; `head` may be null.
  void (*pose)(const FaceShapes&, const float* rest, const float* coefficients, const RigidTransform* joints,
               const RigidTransform* head, int first, int last, float* shaped, float* vertices);
  // Writes sums.shapes, adds to the others.
  void (*backward)(const FaceShapes&, const float* shaped, const RigidTransform* joints, const RigidTransform* head,
                   const float* grad_vertices, int first, int last, float* grad_rest, const FaceSums& sums);
};

}  // namespace mien
