// How far the picture of a lit, textured mesh is from a given one: value and all gradients in one pass.
#pragma once

#include <cstdint>

#include "mesh_gradients.h"

namespace mien {

struct LitSurface {
  const float* normals;       // [v,3] of the mesh's corners, any length but 0
  const float* uv;            // [f,3,2]
  const float* face_weights;  // [f] how far a triangle's pixels count; 0: it hides what is behind it, and shows nothing
  TextureView texture;        // 3 channels
  const float* light;         // [9,3]
};

struct LossTarget {
  const float* image;  // [h,w,3]
  const float* mask;   // [h,w] how far a pixel counts
  float epsilon;       // colours that differ by less pull less
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

// The target itself is the background, and stands for what counts for nothing: only what the mesh covers can differ,
// and silhouettes (of `edges`) are drawn to where colours change. Gradients are of `sum`.
LossValue mesh_loss(const Fragments& fragments, const ImageMesh& mesh, const MeshEdges& edges,
                    const LitSurface& surface, const LossTarget& target, float* picture,
                    const LossGradients& gradients);

}  // namespace mien
