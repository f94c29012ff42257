// Photometric alignment of a textured mesh with a picture: normal equations in one pass, and the texture itself.
#pragma once

#include <cstdint>

#include "mesh.h"

namespace mien {

// The part of a mesh's surface that is aligned. It is the same for every frame.
struct TexturedSurface {
  const float* uv;      // [f,3,2] of every triangle's corners; 0..1, v upwards
  const uint8_t* used;  // [f] whether a triangle is aligned; the others only hide what is behind them
  const float* albedo;  // [th,tw,3]
  const float* trust;   // [th,tw] >= 0; 0 where the texture is not known
  int texture_width;
  int texture_height;
};

struct AlignFrame {
  MeshView view;
  const float* normals;  // [v,3] unit, world
  const float* image;    // [h,w,3]
  const float* mask;     // [h,w] how far a pixel counts
  const float* light;    // [9,3] SH coefficients, as mien.render.mesh.shade
};

struct AlignOptions {
  float sigma;         // expected difference of a colour
  float outlier;       // in sigmas: larger differences count less (Geman and McClure)
  float least_cosine;  // between normal and direction to the camera: steeper surfaces do not count
};

// A difference that is smooth over about this many pixels counts as light that the SH do not explain, and is left out
// of residuals. With 0, nothing is left out.
struct HighPass {
  int radius;
};

struct AlignBuffers {
  float* hessian;   // [p,p] half Hessian of the mean cost, or null for the cost alone
  float* gradient;  // [p] half the gradient
  float* residual;  // [h,w,3] image minus prediction, NaN where nothing counts; or null
  float* smooth;    // [h,w,3] what was left out of the residuals as light, 0 where nothing counts; or null
};

// The mean over counted pixels of rho(|image - albedo * light|^2 / sigma^2), rho(s) = c^2 s / (c^2 + s), and the sum of
// the pixels' weights. `jacobian` [v,3,p] has the derivatives of world positions; those of the light and of
// visibility are left out. One thread; safe to call from several at once.
struct AlignResult {
  double cost;
  double weight;
};
AlignResult align_mesh(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                       const AlignOptions& options, HighPass high_pass, const float* jacobian, int parameters,
                       const AlignBuffers& out);

struct BakeTexels {
  const int32_t* face;       // [th,tw] -1 where no triangle is
  const float* barycentric;  // [th,tw,3]
};

struct BakeSums {
  float* weight;   // [th,tw]
  float* squares;  // [th,tw,3] weight * light^2
  float* mixed;    // [th,tw,3] weight * light * image
  float* image;    // [th,tw,3] weight * image^2
};

// Adds the colours of all texels that a frame shows to the sums. Where `surface.trust` is positive, colours that differ
// from albedo * light count less, as above.
void bake_texture(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                  const AlignOptions& options, const BakeTexels& texels, const BakeSums& out);

// Adds the normal equations of the light given the albedo: hessian [3,9,9] (upper triangles) and right side [3,9].
void light_equations(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                     const AlignOptions& options, double* hessian, double* right);

}  // namespace mien
