// The loss between the picture of a lit, textured mesh and a target: value and all gradients in one pass.
#pragma once

#include <cstdint>

#include "mesh_gradients.h"

namespace mien {

struct LitSurface {
  const float* normals;       // [v,3] of the mesh's corners, any length but 0
  const float* uv;            // [f,3,2]
  const float* face_weights;  // [f] weight of a triangle's pixels; with 0, it only hides what is behind it
  TextureView texture;        // 3 channels
  const float* light;         // [9,3]
};

struct LossTarget {
  const float* image;  // [h,w,3]
  const float* mask;   // [h,w] weight of each pixel
  float epsilon;       // smaller differences of colours have smaller gradients
};

struct LossGradients {  // each is added to
  double* points;       // [v,3]
  float* normals;       // [v,3]
  float* texels;        // [th,tw,3]
  double* light;        // [9,3]
};

struct LossValue {
  double sum;     // of weights times sqrt(|difference|^2 + epsilon^2) - epsilon
  double weight;  // of the pixels that show a triangle which counts
};

// The target itself is the background, and replaces triangles of weight 0. So only pixels that the mesh covers can
// differ, and silhouettes (of `edges`) move to where colours change. Gradients are those of `sum`.
LossValue mesh_loss(const Fragments& fragments, const ImageMesh& mesh, const MeshEdges& edges,
                    const LitSurface& surface, const LossTarget& target, float* picture,
                    const LossGradients& gradients);

}  // namespace mien
