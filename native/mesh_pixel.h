// The operations at one pixel of a mesh's picture, forward and backward. The single operations (mesh_gradients.cpp) and
// the fused loss (mesh_loss.cpp) share them.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "mesh_gradients.h"
#include "sh_basis.h"

namespace mien {

// Gradients of barycentrics, summed over each triangle's pixels before they are chained to its corners.
//
// With corners a, b, c and the pixel q = (x, y, 1), u_a = (b x c) . q and so on are the weights before they are divided
// by their sum, which is det(a, b, c) / depth. So all pixels of a triangle end in three sums of q (Olano and Greer
// 1997).
class FaceMoments {
 public:
  void reset(int64_t faces) { moments_.assign(9 * faces, 0.0); }

  void add(int64_t face, double x, double y, const float* weights, double depth, const float* gradient) {
    const float mean = gradient[0] * weights[0] + gradient[1] * weights[1] + gradient[2] * weights[2];
    double* moment = moments_.data() + 9 * face;
    for (int i = 0; i < 3; ++i, moment += 3) {
      if (weights[i] <= 0) continue;
      const double by_weight = (gradient[i] - mean) * depth;
      moment[0] += by_weight * x;
      moment[1] += by_weight * y;
      moment[2] += by_weight;
    }
  }

  void finish(const ImageMesh& mesh, double* grad_points) const {
    for (int64_t face = 0; face < mesh.face_count; ++face) {
      const double* m = moments_.data() + 9 * face;
      if (std::all_of(m, m + 9, [](double value) { return value == 0; })) continue;
      const int64_t* index = mesh.faces + 3 * face;
      double corner[3][3];
      for (int i = 0; i < 9; ++i) corner[i / 3][i % 3] = mesh.points[3 * index[i / 3] + i % 3];
      double normal[3];
      cross(corner[1], corner[2], normal);
      const double scale = 1 / (corner[0][0] * normal[0] + corner[0][1] * normal[1] + corner[0][2] * normal[2]);
      if (!std::isfinite(scale)) continue;
      for (int i = 0; i < 3; ++i) {
        const int next = (i + 1) % 3, last = (i + 2) % 3;
        double first[3], second[3];
        cross(m + 3 * next, corner[last], first);   // u_next = corner[last] x corner[i] . q
        cross(corner[next], m + 3 * last, second);  // u_last = corner[i] x corner[next] . q
        for (int k = 0; k < 3; ++k) grad_points[3 * index[i] + k] += scale * (first[k] + second[k]);
      }
    }
  }

 private:
  static void cross(const double* a, const double* b, double* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
  }

  std::vector<double> moments_;  // [f,3,3]
};

// Four neighbouring texels and where a point lies between them.
struct Texel {
  int left, right, top, bottom;
  float x, y;              // 0..1 from left to right, from top to bottom
  float scale_x, scale_y;  // derivatives by u and by -v; 0 beyond the borders

  int64_t offset(const TextureView& texture, int corner) const {
    const int64_t row = corner < 2 ? top : bottom, column = corner % 2 == 0 ? left : right;
    return (row * texture.width + column) * texture.channels;
  }
  void corners(const TextureView& texture, const float* out[4]) const {
    for (int k = 0; k < 4; ++k) out[k] = texture.texels + offset(texture, k);
  }
  void weights(float out[4]) const {
    out[0] = (1 - x) * (1 - y), out[1] = x * (1 - y), out[2] = (1 - x) * y, out[3] = x * y;
  }
  void slopes(const float* const corner[4], int c, float gradient, float& by_x, float& by_y) const {
    by_x += gradient * ((1 - y) * (corner[1][c] - corner[0][c]) + y * (corner[3][c] - corner[2][c]));
    by_y += gradient * ((1 - x) * (corner[2][c] - corner[0][c]) + x * (corner[3][c] - corner[1][c]));
  }
};

inline void texel_axis(float coordinate, int size, int& first, int& second, float& between, float& scale) {
  const float last = static_cast<float>(size - 1);
  const float place = coordinate * static_cast<float>(size) - 0.5f;
  const float inside = std::clamp(place == place ? place : 0.0f, 0.0f, last);  // NaN gives the first texel
  first = std::min(static_cast<int>(inside), std::max(size - 2, 0));
  second = std::min(first + 1, size - 1);
  between = inside - static_cast<float>(first);
  scale = place > 0 && place < last ? static_cast<float>(size) : 0.0f;
}

inline Texel texel_at(int width, int height, float u, float v) {
  Texel texel;
  texel_axis(u, width, texel.left, texel.right, texel.x, texel.scale_x);
  texel_axis(1 - v, height, texel.top, texel.bottom, texel.y, texel.scale_y);
  return texel;
}

// Derivatives of `sh_basis` times `gradient` [9], added up.
inline void sh_basis_backward(const float* n, const float gradient[9], float out[3]) {
  const float x = n[0], y = n[1], z = n[2];
  const float* g = gradient;
  out[0] = 0.48860251f * g[3] + 1.09254843f * (y * g[4] + z * g[7] + x * g[8]);
  out[1] = 0.48860251f * g[1] + 1.09254843f * (x * g[4] + z * g[5] - y * g[8]);
  out[2] = 0.48860251f * g[2] + 1.09254843f * (y * g[5] + x * g[7]) + 1.89234939f * z * g[6];
}

}  // namespace mien
