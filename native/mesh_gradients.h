// Gradients through a rasterized mesh: barycentrics, interpolation, textures, antialiased silhouettes, and all of them
// with light and a robust loss in one pass. Everything is double or float sums in a fixed order on one thread.
#pragma once

#include <cstdint>
#include <vector>

namespace mien {

// The triangles that pixels see (`mesh.h`).
struct Fragments {
  const int32_t* face_index;  // [h,w], -1 where no triangle is
  const float* barycentric;   // [h,w,3]
  const float* depth;         // [h,w]
  int width;
  int height;
};

struct ImageMesh {
  const float* points;  // [v,3] K @ camera-space position: (x, y) = pixel * depth, and depth
  int64_t point_count;
  const int64_t* faces;  // [f,3]
  int64_t face_count;
};

struct TextureView {
  const float* texels;  // [th,tw,c]; the first row is at the top, v = 1
  int width;
  int height;
  int channels;
};

// Bilinear look-up, clamped at the borders; uv [n,2], out [n,c].
void sample_texture(const TextureView& texture, const float* uv, int64_t count, float* out);

// The edges of a mesh with their triangles; the second is -1 at a border. An edge is a silhouette if it is at a border,
// or if one of its triangles faces the camera and the other does not.
struct MeshEdges {
  const int32_t* vertices;  // [e,2]
  const int32_t* faces;     // [e,2]
  const int32_t* opposite;  // [e] the first triangle's third vertex
  int64_t count;
};

// Where a silhouette passes between the centres of two neighbouring pixels.
struct Crossing {
  int32_t inner, outer;  // pixels: the mesh's side, the other side
  int32_t edge;
  bool vertical;    // whether the pixels lie above each other
  bool towards;     // whether the outer pixel has the larger coordinate
  double position;  // of the silhouette, from the inner centre (0) to the outer one (1)
  double along;     // of the crossed line of centres: y of a row, x of a column
};

// All crossings, at most one for a pair of pixels, ordered by edge. Walks the mesh's silhouette edges rather than the
// visible triangles' own edges, which are slivers at a contour; tests the depth of the outer pixel only, and keeps the
// outermost crossing of a pair.
void find_crossings(const Fragments& fragments, const ImageMesh& mesh, const MeshEdges& edges,
                    std::vector<Crossing>& crossings);

// Adds the gradient of the points to `grad_points`, from that of a crossing's position.
void crossing_backward(const Crossing& crossing, const ImageMesh& mesh, const MeshEdges& edges, double grad_position,
                       double* grad_points);

// The pixel that a crossing changes, and the share of its neighbour that it gets, 0..1/2.
struct Blend {
  int32_t changed, other;
  float share;
};
inline Blend blend_of(const Crossing& crossing) {
  const float beyond = static_cast<float>(crossing.position - 0.5);
  return beyond > 0 ? Blend{crossing.outer, crossing.inner, beyond} : Blend{crossing.inner, crossing.outer, -beyond};
}

// out = image, blended along silhouettes; both [h,w,c].
void antialias(const std::vector<Crossing>& crossings, const float* image, int64_t pixels, int channels, float* out);
// Writes `grad_image` [h,w,c] and adds to `grad_points`.
void antialias_backward(const std::vector<Crossing>& crossings, const ImageMesh& mesh, const MeshEdges& edges,
                        const float* image, int64_t pixels, int channels, const float* grad_out, float* grad_image,
                        double* grad_points);

}  // namespace mien
