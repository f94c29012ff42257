// Triangle rasterization with a z-buffer: which triangle each pixel centre sees, and where on it.
#pragma once

#include <cstdint>

namespace mien {

struct MeshView {
  const float* K;        // [3,3] row-major, pixels
  const float* viewmat;  // [4,4] row-major, world to camera
  int width;
  int height;
};

struct Mesh {
  const float* vertices;  // [v,3], world, metres
  int64_t vertex_count;
  const int64_t* faces;  // [f,3], each in 0..v-1 (the caller checks)
  int64_t face_count;
};

struct MeshFragmentBuffers {
  int32_t* face_index;  // [h,w], -1 where no triangle is
  float* barycentric;   // [h,w,3], perspective-correct, 0 where no triangle is
  float* depth;         // [h,w], camera z in metres, +infinity where no triangle is
};

// Distance of the near plane, in metres: nearer parts are cut away. It is the same for Gaussians.
inline constexpr double kMeshNearPlane = 0.01;

// Coverage is exact on vertices snapped to 1/256 pixel with the top-left rule, so triangles that share an edge leave
// neither gaps nor double hits. Among equal depths the first triangle wins. Triangles with a vertex that is not
// finite are dropped. One thread; safe to call from several at once.
void rasterize_mesh(const Mesh& mesh, const MeshView& view, bool cull_backfaces, const MeshFragmentBuffers& out);

// out [h,w,c] = sum over a fragment's corners of barycentric * attribute; 0 where no triangle is. `corners` [f,3]
// indexes rows of `attributes` [a,c].
void interpolate_mesh(const int32_t* face_index, const float* barycentric, int64_t pixel_count, const float* attributes,
                      const int64_t* corners, int channels, float* out);

}  // namespace mien
