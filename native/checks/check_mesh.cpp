// Drawing a mesh: triangles of every kind, also degenerate, behind the camera and beyond the picture.
#include "checks.h"
#include "mesh.h"

namespace checks {

void check_mesh() {
  for (uint32_t seed = 0; seed < 6; ++seed) {
    Random random(seed);
    const int sizes[][2] = {{1, 1}, {64, 48}, {33, 5}, {3, 700}, {128, 128}, {17, 90}};
    const int width = sizes[seed][0], height = sizes[seed][1];
    const int64_t vertex_count = 60, face_count = 200, pixels = static_cast<int64_t>(width) * height;
    Floats vertices = random.normal(3 * vertex_count, seed == 3 ? 100 : 1);
    vertices[7] = NAN;
    std::vector<int64_t> faces(3 * face_count);
    for (auto& corner : faces) corner = random.below(vertex_count);
    const float focal = static_cast<float>(width), K[9] = {focal, 0, 0.5f * width, 0, focal, 0.5f * height, 0, 0, 1};
    const float viewmat[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1.5f, 0, 0, 0, 1};
    std::vector<int32_t> face_index(pixels);
    Floats barycentric(3 * pixels), depth(pixels), painted(2 * pixels);
    mien::rasterize_mesh({vertices.data(), vertex_count, faces.data(), face_count}, {K, viewmat, width, height},
                         seed % 2 == 0, {face_index.data(), barycentric.data(), depth.data()});
    CHECK(all_finite(barycentric));
    const Floats attributes = random.normal(2 * vertex_count);
    mien::interpolate_mesh(face_index.data(), barycentric.data(), pixels, attributes.data(), faces.data(), 2,
                           painted.data());
    CHECK(all_finite(painted));
    for (int64_t pixel = 0; pixel < pixels; ++pixel) {
      CHECK(face_index[pixel] >= -1 && face_index[pixel] < face_count);
      if (face_index[pixel] >= 0) CHECK(depth[pixel] > 0);
    }
  }
}

}  // namespace checks
