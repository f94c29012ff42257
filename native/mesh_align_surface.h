// The drawn mesh, points on its surface, samples of the texture, and the light: mesh_align.cpp uses them throughout.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "mesh_align.h"
#include "sh_basis.h"

namespace mien {

struct Color {
  float c[3];
};

struct Sample {
  Color color;
  float weight;
};

struct DrawnMesh {
  std::vector<int32_t> face_index;
  std::vector<float> barycentric, depth;
};

inline Color shade(const float* normal, const float* light) {
  float b[9];
  sh_basis(normal, b);
  Color out{};
  for (int k = 0; k < 9; ++k)
    for (int c = 0; c < 3; ++c) out.c[c] += b[k] * light[3 * k + c];
  return out;
}

// Bilinear among the texels that are known; the weight is their trust.
inline Sample sample_texture(const TexturedSurface& surface, float u, float v) {
  if (!(u == u && v == v)) return {};  // a NaN shows nothing
  const float x = std::clamp(u, 0.0f, 1.0f) * surface.texture_width - 0.5f;
  const float y = (1 - std::clamp(v, 0.0f, 1.0f)) * surface.texture_height - 0.5f;
  const int x0 = static_cast<int>(std::floor(x)), y0 = static_cast<int>(std::floor(y));
  Sample out{};
  for (int dy = 0; dy < 2; ++dy) {
    for (int dx = 0; dx < 2; ++dx) {
      const int column = std::clamp(x0 + dx, 0, surface.texture_width - 1);
      const int row = std::clamp(y0 + dy, 0, surface.texture_height - 1);
      const int64_t texel = static_cast<int64_t>(row) * surface.texture_width + column;
      const float share = (dx ? x - x0 : 1 - (x - x0)) * (dy ? y - y0 : 1 - (y - y0)) * surface.trust[texel];
      out.weight += share;
      for (int c = 0; c < 3; ++c) out.color.c[c] += share * surface.albedo[3 * texel + c];
    }
  }
  if (out.weight > 0)
    for (float& value : out.color.c) value /= out.weight;
  return out;
}

struct SurfacePoint {
  float position[3], normal[3];
  float cosine;  // between the normal and the direction to the camera
};

inline SurfacePoint surface_point(const Mesh& mesh, const AlignFrame& frame, const float* eye, const int64_t* corners,
                                  const float* weights) {
  SurfacePoint out{};
  for (int k = 0; k < 3; ++k) {
    for (int axis = 0; axis < 3; ++axis) {
      out.position[axis] += weights[k] * mesh.vertices[3 * corners[k] + axis];
      out.normal[axis] += weights[k] * frame.normals[3 * corners[k] + axis];
    }
  }
  float length = 0, distance = 0, along = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const float towards = eye[axis] - out.position[axis];
    length += out.normal[axis] * out.normal[axis];
    distance += towards * towards;
    along += towards * out.normal[axis];
  }
  length = std::sqrt(length) + 1e-20f;
  for (float& value : out.normal) value /= length;
  out.cosine = along / (length * std::sqrt(distance) + 1e-20f);
  return out;
}

inline void camera_position(const float* viewmat, float* eye) {
  for (int axis = 0; axis < 3; ++axis) {
    eye[axis] = 0;
    for (int k = 0; k < 3; ++k) eye[axis] -= viewmat[4 * k + axis] * viewmat[4 * k + 3];
  }
}

inline void draw(const Mesh& mesh, const MeshView& view, DrawnMesh& drawn) {
  const size_t pixels = static_cast<size_t>(view.width) * view.height;
  drawn.face_index.resize(pixels);
  drawn.barycentric.resize(3 * pixels);
  drawn.depth.resize(pixels);
  rasterize_mesh(mesh, view, false, {drawn.face_index.data(), drawn.barycentric.data(), drawn.depth.data()});
}

// Calls body(pixel, face, corners, barycentrics, point, texture sample, light) for every pixel that counts.
template <typename Body>
void for_pixels(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame, const AlignOptions& options,
                const DrawnMesh& drawn, Body&& body) {
  float eye[3];
  camera_position(frame.view.viewmat, eye);
  const int width = frame.view.width, height = frame.view.height;
  for (int y = 1; y + 1 < height; ++y) {
    for (int x = 1; x + 1 < width; ++x) {
      const int64_t pixel = static_cast<int64_t>(y) * width + x;
      const int32_t face = drawn.face_index[pixel];
      if (face < 0 || !surface.used[face] || !(frame.mask[pixel] > 0)) continue;
      const int64_t* corners = mesh.faces + 3 * static_cast<int64_t>(face);
      const float* weights = drawn.barycentric.data() + 3 * pixel;
      const SurfacePoint point = surface_point(mesh, frame, eye, corners, weights);
      if (point.cosine < options.least_cosine) continue;
      const float* uv = surface.uv + 6 * static_cast<int64_t>(face);
      const Sample sample = sample_texture(surface, weights[0] * uv[0] + weights[1] * uv[2] + weights[2] * uv[4],
                                           weights[0] * uv[1] + weights[1] * uv[3] + weights[2] * uv[5]);
      if (!(sample.weight > 0)) continue;
      body(pixel, face, weights, point, sample, shade(point.normal, frame.light));
    }
  }
}

inline float squared_norm(const Color& color) {
  return color.c[0] * color.c[0] + color.c[1] * color.c[1] + color.c[2] * color.c[2];
}

// Geman and McClure: rho(s) = s * fading(s), and its derivative is the square of fading(s).
inline float fading(float squared, const AlignOptions& options) {
  const float least = options.outlier * options.outlier;
  return least / (least + squared);
}

// The calling thread's own buffers, kept between calls: fresh pages cost as much as the work.
inline DrawnMesh& own_drawing() {
  thread_local DrawnMesh drawing;
  return drawing;
}

}  // namespace mien
