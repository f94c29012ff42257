#include <algorithm>
#include <cmath>

#include "mesh_align_surface.h"

namespace mien {
namespace {

constexpr float kDepthTolerance = 0.0005f;  // metres: a texel so far behind what is seen is hidden

}  // namespace

void bake_texture(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                  const AlignOptions& options, const BakeTexels& texels, const BakeSums& out) {
  DrawnMesh& drawn = own_drawing();
  draw(mesh, frame.view, drawn);
  float eye[3];
  camera_position(frame.view.viewmat, eye);
  const MeshView& view = frame.view;
  const float least = options.outlier * options.outlier, inverse_variance = 1 / (options.sigma * options.sigma);
  const int64_t count = static_cast<int64_t>(surface.texture_width) * surface.texture_height;
  for (int64_t texel = 0; texel < count; ++texel) {
    const int32_t face = texels.face[texel];
    if (face < 0 || !surface.used[face]) continue;
    const SurfacePoint point =
        surface_point(mesh, frame, eye, mesh.faces + 3 * static_cast<int64_t>(face), texels.barycentric + 3 * texel);
    if (point.cosine < options.least_cosine) continue;
    float in_camera[3];
    for (int row = 0; row < 3; ++row) {
      const float* m = view.viewmat + 4 * row;
      in_camera[row] = m[0] * point.position[0] + m[1] * point.position[1] + m[2] * point.position[2] + m[3];
    }
    if (in_camera[2] < kMeshNearPlane) continue;
    const float x = view.K[0] * in_camera[0] / in_camera[2] + view.K[2] - 0.5f;
    const float y = view.K[4] * in_camera[1] / in_camera[2] + view.K[5] - 0.5f;
    if (!(x >= 0 && y >= 0 && x < view.width - 1 && y < view.height - 1)) continue;
    const int x0 = static_cast<int>(x), y0 = static_cast<int>(y);
    const int64_t nearest = static_cast<int64_t>(std::lround(y)) * view.width + std::lround(x);
    // What a slope rises within a pixel does not hide it.
    const float slope = std::sqrt(std::max(1 - point.cosine * point.cosine, 0.0f)) / std::max(point.cosine, 0.1f);
    const float tolerance = kDepthTolerance + in_camera[2] / view.K[0] * slope;
    if (in_camera[2] > drawn.depth[nearest] + tolerance) continue;
    float color[3] = {}, mask = 0;
    for (int dy = 0; dy < 2; ++dy) {
      for (int dx = 0; dx < 2; ++dx) {
        const float share = (dx ? x - x0 : 1 - (x - x0)) * (dy ? y - y0 : 1 - (y - y0));
        const int64_t pixel = static_cast<int64_t>(y0 + dy) * view.width + x0 + dx;
        mask += share * frame.mask[pixel];
        for (int c = 0; c < 3; ++c) color[c] += share * frame.image[3 * pixel + c];
      }
    }
    const Color light = shade(point.normal, frame.light);
    float weight = mask * point.cosine * point.cosine;
    if (surface.trust[texel] > 0) {
      float squared = 0;
      for (int c = 0; c < 3; ++c) {
        const float difference = color[c] - surface.albedo[3 * texel + c] * light.c[c];
        squared += difference * difference * inverse_variance;
      }
      const float fade = least / (least + squared);
      weight *= fade * fade;
    }
    out.weight[texel] += weight;
    for (int c = 0; c < 3; ++c) {
      out.squares[3 * texel + c] += weight * light.c[c] * light.c[c];
      out.mixed[3 * texel + c] += weight * light.c[c] * color[c];
      out.image[3 * texel + c] += weight * color[c] * color[c];
    }
  }
}

void light_equations(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                     const AlignOptions& options, double* hessian, double* right) {
  DrawnMesh& drawn = own_drawing();
  draw(mesh, frame.view, drawn);
  const float least = options.outlier * options.outlier, inverse_variance = 1 / (options.sigma * options.sigma);
  for_pixels(
      mesh, surface, frame, options, drawn,
      [&](int64_t pixel, int32_t, const float*, const SurfacePoint& point, const Sample& sample, const Color& light) {
        float b[9], squared = 0;
        sh_basis(point.normal, b);
        const float* seen = frame.image + 3 * pixel;
        for (int c = 0; c < 3; ++c) {
          const float difference = seen[c] - sample.color.c[c] * light.c[c];
          squared += difference * difference * inverse_variance;
        }
        const float fade = least / (least + squared);
        for (int c = 0; c < 3; ++c) {
          const float albedo = sample.color.c[c], weight = frame.mask[pixel] * sample.weight * fade * fade * albedo;
          for (int i = 0; i < 9; ++i) {
            right[9 * c + i] += weight * b[i] * seen[c];
            for (int j = i; j < 9; ++j) hessian[81 * c + 9 * i + j] += weight * albedo * b[i] * b[j];
          }
        }
      });
}

}  // namespace mien
