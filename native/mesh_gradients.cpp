#include "mesh_gradients.h"

#include <algorithm>

#include "mesh_pixel.h"

namespace mien {

void barycentric_backward(const Fragments& fragments, const ImageMesh& mesh, const float* grad_barycentric,
                          double* grad_points) {
  thread_local FaceMoments moments;
  moments.reset(mesh.face_count);
  for (int y = 0; y < fragments.height; ++y) {
    for (int x = 0; x < fragments.width; ++x) {
      const int64_t pixel = static_cast<int64_t>(y) * fragments.width + x;
      if (fragments.face_index[pixel] < 0) continue;
      moments.add(fragments.face_index[pixel], x + 0.5, y + 0.5, fragments.barycentric + 3 * pixel,
                  fragments.depth[pixel], grad_barycentric + 3 * pixel);
    }
  }
  moments.finish(mesh, grad_points);
}

void interpolate_backward(const Fragments& fragments, const float* attributes, const int64_t* corners, int channels,
                          const float* grad_out, float* grad_attributes, float* grad_barycentric) {
  const int64_t pixels = static_cast<int64_t>(fragments.width) * fragments.height;
  for (int64_t pixel = 0; pixel < pixels; ++pixel) {
    float* by_weight = grad_barycentric == nullptr ? nullptr : grad_barycentric + 3 * pixel;
    if (fragments.face_index[pixel] < 0) {
      if (by_weight != nullptr) std::fill_n(by_weight, 3, 0.0f);
      continue;
    }
    const int64_t* index = corners + 3 * static_cast<int64_t>(fragments.face_index[pixel]);
    const float* from = grad_out + pixel * channels;
    for (int corner = 0; corner < 3; ++corner) {
      const int64_t row = index[corner] * channels;
      const float weight = fragments.barycentric[3 * pixel + corner];
      if (grad_attributes != nullptr) {
        for (int i = 0; i < channels; ++i) grad_attributes[row + i] += weight * from[i];
      }
      if (by_weight != nullptr) {
        float sum = 0;
        for (int i = 0; i < channels; ++i) sum += attributes[row + i] * from[i];
        by_weight[corner] = sum;
      }
    }
  }
}

void sample_texture(const TextureView& texture, const float* uv, int64_t count, float* out) {
  for (int64_t i = 0; i < count; ++i) {
    const Texel texel = texel_at(texture.width, texture.height, uv[2 * i], uv[2 * i + 1]);
    const float* corner[4];
    texel.corners(texture, corner);
    float* to = out + i * texture.channels;
    for (int c = 0; c < texture.channels; ++c) {
      const float top = corner[0][c] + texel.x * (corner[1][c] - corner[0][c]);
      const float bottom = corner[2][c] + texel.x * (corner[3][c] - corner[2][c]);
      to[c] = top + texel.y * (bottom - top);
    }
  }
}

void sample_texture_backward(const TextureView& texture, const float* uv, int64_t count, const float* grad_out,
                             float* grad_texels, float* grad_uv) {
  for (int64_t i = 0; i < count; ++i) {
    const Texel texel = texel_at(texture.width, texture.height, uv[2 * i], uv[2 * i + 1]);
    const float* from = grad_out + i * texture.channels;
    if (grad_texels != nullptr) {
      float weight[4];
      texel.weights(weight);
      for (int k = 0; k < 4; ++k) {
        float* to = grad_texels + texel.offset(texture, k);
        for (int c = 0; c < texture.channels; ++c) to[c] += weight[k] * from[c];
      }
    }
    if (grad_uv != nullptr) {
      const float* corner[4];
      texel.corners(texture, corner);
      float by_x = 0, by_y = 0;
      for (int c = 0; c < texture.channels; ++c) texel.slopes(corner, c, from[c], by_x, by_y);
      grad_uv[2 * i] = by_x * texel.scale_x;
      grad_uv[2 * i + 1] = -by_y * texel.scale_y;
    }
  }
}

}  // namespace mien
