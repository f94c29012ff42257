#include "mesh_gradients.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "mesh.h"
#include "mesh_pixel.h"

namespace mien {

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

namespace {

struct EdgeEnds {
  double x[2], y[2], inverse_depth[2];
};

// The sign tells which side of a triangle is seen. It is 0 if the triangle is seen edge-on.
double facing(const ImageMesh& mesh, int64_t face) {
  const int64_t* index = mesh.faces + 3 * face;
  const float *a = mesh.points + 3 * index[0], *b = mesh.points + 3 * index[1], *c = mesh.points + 3 * index[2];
  const auto product = [](double p, double q) { return p * q; };
  return a[0] * (product(b[1], c[2]) - product(b[2], c[1])) + a[1] * (product(b[2], c[0]) - product(b[0], c[2])) +
         a[2] * (product(b[0], c[1]) - product(b[1], c[0]));
}

bool project_edge(const ImageMesh& mesh, const int32_t* vertices, EdgeEnds& ends) {
  for (int i = 0; i < 2; ++i) {
    const float* point = mesh.points + 3 * static_cast<int64_t>(vertices[i]);
    if (!(point[2] >= kMeshNearPlane)) return false;
    ends.inverse_depth[i] = 1.0 / point[2];
    ends.x[i] = point[0] * ends.inverse_depth[i];
    ends.y[i] = point[1] * ends.inverse_depth[i];
    if (!std::isfinite(ends.x[i]) || !std::isfinite(ends.y[i])) return false;
  }
  return true;
}

class Walker {
 public:
  Walker(const Fragments& fragments, std::vector<Crossing>& out) : fragments_(fragments), out_(out) {}

  // All lines of pixel centres that an edge crosses; the mesh lies on the side of (x, y).
  void walk(int32_t edge, const EdgeEnds& ends, double inside_x, double inside_y) {
    const double dx = ends.x[1] - ends.x[0], dy = ends.y[1] - ends.y[0];
    const bool vertical = std::abs(dx) > std::abs(dy);  // whether pixels above each other are compared
    const double* along = vertical ? ends.x : ends.y;
    const double* across = vertical ? ends.y : ends.x;
    const double length = along[1] - along[0];
    if (length == 0) return;
    const double side = dx * (inside_y - ends.y[0]) - dy * (inside_x - ends.x[0]);
    // Whether the mesh's side of the edge has the smaller coordinate across it.
    const bool towards = (vertical ? side * dx : -side * dy) < 0;
    const int lines = vertical ? fragments_.width : fragments_.height;
    const double low = std::min(along[0], along[1]), high = std::max(along[0], along[1]);
    const int first = static_cast<int>(std::clamp(std::ceil(low - 0.5), 0.0, static_cast<double>(lines)));
    const int last = static_cast<int>(std::clamp(std::ceil(high - 0.5), 0.0, static_cast<double>(lines)));
    for (int line = first; line < last; ++line) {
      const double t = (line + 0.5 - along[0]) / length;
      const double at = across[0] + t * (across[1] - across[0]);
      const double inverse_depth = ends.inverse_depth[0] + t * (ends.inverse_depth[1] - ends.inverse_depth[0]);
      cross(edge, line, at, inverse_depth, vertical, towards);
    }
  }

 private:
  void cross(int32_t edge, int line, double at, double inverse_depth, bool vertical, bool towards) {
    const int size = vertical ? fragments_.height : fragments_.width;
    const double place = std::floor(at - 0.5);
    if (!(place >= 0 && place + 1 < size)) return;
    const int before = static_cast<int>(place);
    const auto pixel = [&](int across) {
      return vertical ? across * fragments_.width + line : line * fragments_.width + across;
    };
    const int32_t inner = pixel(towards ? before : before + 1), outer = pixel(towards ? before + 1 : before);
    if (fragments_.face_index[inner] < 0) return;
    if (!(inverse_depth * fragments_.depth[outer] > 1)) return;  // the surface at the outer pixel hides the edge
    const double beyond = at - 0.5 - before;
    out_.push_back({inner, outer, edge, vertical, towards, towards ? beyond : 1 - beyond, line + 0.5});
  }

  const Fragments& fragments_;
  std::vector<Crossing>& out_;
};

// Keeps the outermost of the crossings between the same two pixels in the same direction.
void keep_outermost(std::vector<Crossing>& crossings, int64_t pixels) {
  // A pixel has at most four neighbours, so a pair in one direction is a slot of its inner pixel.
  thread_local std::vector<int32_t> best;
  best.resize(4 * pixels, -1);
  const auto slot = [](const Crossing& c) { return 4 * static_cast<int64_t>(c.inner) + 2 * c.vertical + c.towards; };
  for (size_t i = 0; i < crossings.size(); ++i) {
    int32_t& kept = best[slot(crossings[i])];
    if (kept < 0 || crossings[i].position > crossings[kept].position) kept = static_cast<int32_t>(i);
  }
  size_t count = 0;
  for (size_t i = 0; i < crossings.size(); ++i) {
    if (best[slot(crossings[i])] == static_cast<int32_t>(i)) crossings[count++] = crossings[i];
  }
  // Only what was set is set back, so that the buffer need not be cleared in every call.
  for (size_t i = 0; i < count; ++i) best[slot(crossings[i])] = -1;
  crossings.resize(count);
}

}  // namespace

void find_crossings(const Fragments& fragments, const ImageMesh& mesh, const MeshEdges& edges,
                    std::vector<Crossing>& crossings) {
  thread_local std::vector<signed char> front;
  front.resize(mesh.face_count);
  for (int64_t face = 0; face < mesh.face_count; ++face) {
    const double sign = facing(mesh, face);
    front[face] = static_cast<signed char>(sign > 0 ? 1 : sign < 0 ? -1 : 0);
  }
  crossings.clear();
  Walker walker(fragments, crossings);
  for (int64_t edge = 0; edge < edges.count; ++edge) {
    const int32_t* faces = edges.faces + 2 * edge;
    if (faces[1] >= 0 && front[faces[0]] == front[faces[1]]) continue;
    EdgeEnds ends;
    if (!project_edge(mesh, edges.vertices + 2 * edge, ends)) continue;
    const float* inside = mesh.points + 3 * static_cast<int64_t>(edges.opposite[edge]);
    if (!(inside[2] >= kMeshNearPlane)) continue;
    walker.walk(static_cast<int32_t>(edge), ends, inside[0] / static_cast<double>(inside[2]),
                inside[1] / static_cast<double>(inside[2]));
  }
  keep_outermost(crossings, static_cast<int64_t>(fragments.width) * fragments.height);
}

void crossing_backward(const Crossing& crossing, const ImageMesh& mesh, const MeshEdges& edges, double grad_position,
                       double* grad_points) {
  const int32_t* vertices = edges.vertices + 2 * static_cast<int64_t>(crossing.edge);
  EdgeEnds ends;
  if (!project_edge(mesh, vertices, ends)) return;
  const double* along = crossing.vertical ? ends.x : ends.y;
  const double* across = crossing.vertical ? ends.y : ends.x;
  const double length = along[1] - along[0];
  const double t = (crossing.along - along[0]) / length;
  const double slope = (across[1] - across[0]) / length;
  const double gradient = crossing.towards ? grad_position : -grad_position;
  for (int i = 0; i < 2; ++i) {
    const double by_across = gradient * (i == 0 ? 1 - t : t), by_along = -slope * by_across;
    const double by_x = crossing.vertical ? by_along : by_across, by_y = crossing.vertical ? by_across : by_along;
    double* to = grad_points + 3 * static_cast<int64_t>(vertices[i]);
    to[0] += by_x * ends.inverse_depth[i];
    to[1] += by_y * ends.inverse_depth[i];
    to[2] -= (by_x * ends.x[i] + by_y * ends.y[i]) * ends.inverse_depth[i];
  }
}

void antialias(const std::vector<Crossing>& crossings, const float* image, int64_t pixels, int channels, float* out) {
  std::copy_n(image, pixels * channels, out);
  for (const Crossing& crossing : crossings) {
    const Blend blend = blend_of(crossing);
    const float *here = image + static_cast<int64_t>(blend.changed) * channels,
                *there = image + static_cast<int64_t>(blend.other) * channels;
    float* to = out + static_cast<int64_t>(blend.changed) * channels;
    for (int c = 0; c < channels; ++c) to[c] += blend.share * (there[c] - here[c]);
  }
}

void antialias_backward(const std::vector<Crossing>& crossings, const ImageMesh& mesh, const MeshEdges& edges,
                        const float* image, int64_t pixels, int channels, const float* grad_out, float* grad_image,
                        double* grad_points) {
  std::copy_n(grad_out, pixels * channels, grad_image);
  for (const Crossing& crossing : crossings) {
    const Blend blend = blend_of(crossing);
    const int64_t here = static_cast<int64_t>(blend.changed) * channels;
    const int64_t there = static_cast<int64_t>(blend.other) * channels;
    double by_share = 0;
    for (int c = 0; c < channels; ++c) {
      const float gradient = grad_out[here + c];
      grad_image[here + c] -= blend.share * gradient;
      grad_image[there + c] += blend.share * gradient;
      by_share += static_cast<double>(gradient) * (image[there + c] - image[here + c]);
    }
    const double by_position = crossing.position > 0.5 ? by_share : -by_share;
    if (by_position != 0) crossing_backward(crossing, mesh, edges, by_position, grad_points);
  }
}

}  // namespace mien
