#include "mesh_loss.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "mesh_pixel.h"

namespace mien {
namespace {

// A pixel that shows a triangle of positive weight, in the form in which the forward pass leaves it.
struct LitPixel {
  int32_t pixel, face;
  Texel texel;
  float albedo[3], shading[3], normal[3], inverse_length;
};

struct Workspace {  // kept between calls: fresh pages cost as much as the work
  std::vector<LitPixel> pixels;
  std::vector<Crossing> crossings;
  std::vector<float> colors, blended, gradient, by_color;
  FaceMoments moments;
};

class Renderer {
 public:
  Renderer(const Fragments& fragments, const ImageMesh& mesh, const LitSurface& surface)
      : fragments_(fragments), mesh_(mesh), surface_(surface) {}

  // Fills in everything but `pixel` and `face`; returns the colour.
  void shade(LitPixel& lit, float color[3]) const {
    const float* weights = fragments_.barycentric + 3 * static_cast<int64_t>(lit.pixel);
    const int64_t* index = mesh_.faces + 3 * static_cast<int64_t>(lit.face);
    const float* uv = surface_.uv + 6 * static_cast<int64_t>(lit.face);
    float normal[3] = {0, 0, 0}, u = 0, v = 0;
    for (int i = 0; i < 3; ++i) {
      const float* corner = surface_.normals + 3 * index[i];
      for (int k = 0; k < 3; ++k) normal[k] += weights[i] * corner[k];
      u += weights[i] * uv[2 * i];
      v += weights[i] * uv[2 * i + 1];
    }
    const float squared = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
    lit.inverse_length = squared > 1e-24f ? 1 / std::sqrt(squared) : 0.0f;
    for (int k = 0; k < 3; ++k) lit.normal[k] = normal[k] * lit.inverse_length;
    lit.texel = texel_at(surface_.texture.width, surface_.texture.height, u, v);
    const float* texels[4];
    lit.texel.corners(surface_.texture, texels);
    float basis[9], share[4];
    sh_basis(lit.normal, basis);
    lit.texel.weights(share);
    for (int c = 0; c < 3; ++c) {
      float albedo = 0, shading = 0;
      for (int k = 0; k < 4; ++k) albedo += share[k] * texels[k][c];
      for (int k = 0; k < 9; ++k) shading += basis[k] * surface_.light[3 * k + c];
      lit.albedo[c] = albedo;
      lit.shading[c] = shading;
      color[c] = albedo * shading;
    }
  }

  // From the gradient of a pixel's colour to texture, light, normals and barycentrics.
  void backward(const LitPixel& lit, const float gradient[3], const LossGradients& out, float by_weight[3]) const {
    const float* weights = fragments_.barycentric + 3 * static_cast<int64_t>(lit.pixel);
    const int64_t* index = mesh_.faces + 3 * static_cast<int64_t>(lit.face);
    const float* uv = surface_.uv + 6 * static_cast<int64_t>(lit.face);
    const float* texels[4];
    lit.texel.corners(surface_.texture, texels);
    float share[4], basis[9], by_basis[9] = {}, by_x = 0, by_y = 0;
    lit.texel.weights(share);
    sh_basis(lit.normal, basis);
    for (int c = 0; c < 3; ++c) {
      const float by_albedo = gradient[c] * lit.shading[c], by_shading = gradient[c] * lit.albedo[c];
      for (int k = 0; k < 4; ++k) out.texels[lit.texel.offset(surface_.texture, k) + c] += share[k] * by_albedo;
      lit.texel.slopes(texels, c, by_albedo, by_x, by_y);
      for (int k = 0; k < 9; ++k) {
        by_basis[k] += by_shading * surface_.light[3 * k + c];
        light_[3 * k + c] += by_shading * basis[k];
      }
    }
    const float by_u = by_x * lit.texel.scale_x, by_v = -by_y * lit.texel.scale_y;
    float by_unit[3], by_normal[3];
    sh_basis_backward(lit.normal, by_basis, by_unit);
    const float radial = by_unit[0] * lit.normal[0] + by_unit[1] * lit.normal[1] + by_unit[2] * lit.normal[2];
    for (int k = 0; k < 3; ++k) by_normal[k] = (by_unit[k] - radial * lit.normal[k]) * lit.inverse_length;
    for (int i = 0; i < 3; ++i) {
      const float* corner = surface_.normals + 3 * index[i];
      float* to = out.normals + 3 * index[i];
      by_weight[i] = by_u * uv[2 * i] + by_v * uv[2 * i + 1];
      for (int k = 0; k < 3; ++k) {
        by_weight[i] += by_normal[k] * corner[k];
        to[k] += weights[i] * by_normal[k];
      }
    }
  }

  void add_light(double* out) const {
    for (int i = 0; i < 27; ++i) out[i] += light_[i];
  }

 private:
  const Fragments& fragments_;
  const ImageMesh& mesh_;
  const LitSurface& surface_;
  mutable double light_[27] = {};
};

// Adds the pixel's loss and writes its gradient.
double pixel_loss(const float* color, const float* target, float weight, float epsilon, float* gradient) {
  float difference[3], squared = epsilon * epsilon;
  for (int c = 0; c < 3; ++c) {
    difference[c] = color[c] - target[c];
    squared += difference[c] * difference[c];
  }
  const float length = std::sqrt(squared);
  const float scale = length > 0 ? weight / length : 0.0f;
  for (int c = 0; c < 3; ++c) gradient[c] = scale * difference[c];
  return static_cast<double>(weight) * (length - epsilon);
}

}  // namespace

LossValue mesh_loss(const Fragments& fragments, const ImageMesh& mesh, const MeshEdges& edges,
                    const LitSurface& surface, const LossTarget& target, float* picture,
                    const LossGradients& gradients) {
  thread_local Workspace work;
  const int64_t pixels = static_cast<int64_t>(fragments.width) * fragments.height;
  const auto face_weight = [&](int64_t pixel) {
    return fragments.face_index[pixel] < 0 ? 0.0f : surface.face_weights[fragments.face_index[pixel]];
  };
  Renderer renderer(fragments, mesh, surface);
  LossValue value{0, 0};
  work.pixels.clear();
  work.colors.assign(target.image, target.image + 3 * pixels);
  for (int64_t pixel = 0; pixel < pixels; ++pixel) {
    if (!(face_weight(pixel) > 0)) continue;
    LitPixel& lit = work.pixels.emplace_back();
    lit.pixel = static_cast<int32_t>(pixel);
    lit.face = fragments.face_index[pixel];
    renderer.shade(lit, work.colors.data() + 3 * pixel);
    value.weight += static_cast<double>(face_weight(pixel)) * target.mask[pixel];
  }
  find_crossings(fragments, mesh, edges, work.crossings);
  float* blended = picture;
  if (blended == nullptr) {
    work.blended.resize(3 * pixels);
    blended = work.blended.data();
  }
  antialias(work.crossings, work.colors.data(), pixels, 3, blended);

  work.gradient.assign(3 * pixels, 0.0f);
  const auto count = [&](int64_t pixel, float weight) {
    value.sum += pixel_loss(blended + 3 * pixel, target.image + 3 * pixel, weight * target.mask[pixel], target.epsilon,
                            work.gradient.data() + 3 * pixel);
  };
  for (const LitPixel& lit : work.pixels) count(lit.pixel, face_weight(lit.pixel));
  for (const Crossing& crossing : work.crossings) {
    // Other pixels change only here. One that has a gradient has been counted by a crossing before.
    const int64_t changed = blend_of(crossing).changed;
    const float* gradient = work.gradient.data() + 3 * changed;
    const bool counted = gradient[0] != 0 || gradient[1] != 0 || gradient[2] != 0;
    if (!counted && !(face_weight(changed) > 0)) count(changed, 1.0f);
  }

  work.by_color.resize(3 * pixels);
  antialias_backward(work.crossings, mesh, edges, work.colors.data(), pixels, 3, work.gradient.data(),
                     work.by_color.data(), gradients.points);
  work.moments.reset(mesh.face_count);
  for (const LitPixel& lit : work.pixels) {
    const float* by_color = work.by_color.data() + 3 * static_cast<int64_t>(lit.pixel);
    float by_weight[3];
    renderer.backward(lit, by_color, gradients, by_weight);
    const int64_t y = lit.pixel / fragments.width, x = lit.pixel % fragments.width;
    work.moments.add(lit.face, x + 0.5, y + 0.5, fragments.barycentric + 3 * static_cast<int64_t>(lit.pixel),
                     fragments.depth[lit.pixel], by_weight);
  }
  work.moments.finish(mesh, gradients.points);
  renderer.add_light(gradients.light);
  return value;
}

}  // namespace mien
