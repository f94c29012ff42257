#include "mesh.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace mien {
namespace {

constexpr int kSubpixelBits = 8;
constexpr int64_t kSubpixels = 1 << kSubpixelBits;
// Clamps snapped coordinates so that products of their differences stay well inside 64 bits.
constexpr double kMaxPixel = 1 << 21;

struct Point {
  double x, y, z;
};

struct Snapped {
  int64_t x, y;
};

// Homogeneous edge functions of a triangle (Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous
// coordinates"): row i times (x, y, 1) is barycentric i over depth at pixel position (x, y), also when vertices lie
// behind the camera.
struct EdgePlanes {
  double rows[3][3];
};

struct Workspace {
  std::vector<Point> points;  // K @ camera-space position: (x, y) = pixel * z
  std::vector<EdgePlanes> planes;
};

Point cross(const Point& a, const Point& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

bool edge_planes(const Point& a, const Point& b, const Point& c, EdgePlanes& planes) {
  const Point rows[3] = {cross(b, c), cross(c, a), cross(a, b)};
  const double determinant = a.x * rows[0].x + a.y * rows[0].y + a.z * rows[0].z;
  if (!(std::abs(determinant) > std::numeric_limits<double>::min())) return false;
  for (int i = 0; i < 3; ++i) {
    planes.rows[i][0] = rows[i].x / determinant;
    planes.rows[i][1] = rows[i].y / determinant;
    planes.rows[i][2] = rows[i].z / determinant;
  }
  return true;
}

// The part of a triangle beyond the near plane: 0, 3 or 4 corners (Sutherland and Hodgman).
int clip_near(const Point corners[3], Point clipped[4]) {
  int count = 0;
  for (int i = 0; i < 3; ++i) {
    const Point& from = corners[i];
    const Point& to = corners[(i + 1) % 3];
    const bool from_inside = from.z >= kMeshNearPlane;
    if (from_inside) clipped[count++] = from;
    if (from_inside != (to.z >= kMeshNearPlane)) {
      // Always from the inner end, so that two triangles cut their shared edge at the same point.
      const Point& inner = from_inside ? from : to;
      const Point& outer = from_inside ? to : from;
      const double t = (inner.z - kMeshNearPlane) / (inner.z - outer.z);
      clipped[count++] = {inner.x + t * (outer.x - inner.x), inner.y + t * (outer.y - inner.y), kMeshNearPlane};
    }
  }
  return count;
}

Snapped snap(const Point& point) {
  const auto coordinate = [&](double value) {
    return std::llrint(std::clamp(value / point.z, -kMaxPixel, kMaxPixel) * kSubpixels);
  };
  return {coordinate(point.x), coordinate(point.y)};
}

int64_t doubled_area(const Snapped& a, const Snapped& b, const Snapped& c) {
  return (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
}

// First pixel whose centre is at or after a snapped coordinate.
int64_t first_pixel(int64_t snapped) { return (snapped + kSubpixels / 2 - 1) >> kSubpixelBits; }

struct Edge {
  int64_t value, step_x, step_y;

  // Not negative at the pixel centres that a triangle with positive area keeps at its edge a -> b: a centre exactly
  // on the edge belongs to the triangle only if the edge is its top or left one.
  Edge(const Snapped& a, const Snapped& b, int64_t column, int64_t row) {
    const int64_t x = column * kSubpixels + kSubpixels / 2, y = row * kSubpixels + kSubpixels / 2;
    const int64_t dx = b.x - a.x, dy = b.y - a.y;
    const bool top_left = dy < 0 || (dy == 0 && dx > 0);
    value = dx * (y - a.y) - dy * (x - a.x) - (top_left ? 0 : 1);
    step_x = -dy * kSubpixels;
    step_y = dx * kSubpixels;
  }
};

class DepthBuffer {
 public:
  DepthBuffer(const MeshView& view, const MeshFragmentBuffers& out)
      : width_(view.width), height_(view.height), face_index_(out.face_index), inverse_depth_(out.depth) {
    std::fill_n(face_index_, static_cast<int64_t>(width_) * height_, -1);
    std::fill_n(inverse_depth_, static_cast<int64_t>(width_) * height_, 0.0f);
  }

  // Draws one triangle of the clipped face; `depths` bounds 1 / z, which extrapolation could leave on slivers.
  void draw(int32_t face, Snapped a, Snapped b, Snapped c, const EdgePlanes& planes, const double depths[2]) {
    const int64_t area = doubled_area(a, b, c);
    if (area == 0) return;
    if (area < 0) std::swap(b, c);
    const int64_t left = std::max<int64_t>(first_pixel(std::min({a.x, b.x, c.x})), 0);
    const int64_t top = std::max<int64_t>(first_pixel(std::min({a.y, b.y, c.y})), 0);
    const int64_t right = std::min<int64_t>(first_pixel(std::max({a.x, b.x, c.x}) + 1), width_);
    const int64_t bottom = std::min<int64_t>(first_pixel(std::max({a.y, b.y, c.y}) + 1), height_);
    if (left >= right || top >= bottom) return;
    Edge edges[3] = {Edge(a, b, left, top), Edge(b, c, left, top), Edge(c, a, left, top)};
    const auto slope = [&](int i) { return planes.rows[0][i] + planes.rows[1][i] + planes.rows[2][i]; };
    const double slope_x = slope(0), slope_y = slope(1);
    double row_depth = slope_x * (left + 0.5) + slope_y * (top + 0.5) + slope(2);
    for (int64_t y = top; y < bottom; ++y, row_depth += slope_y) {
      int64_t e0 = edges[0].value, e1 = edges[1].value, e2 = edges[2].value;
      float* row = inverse_depth_ + y * width_;
      for (int64_t x = left; x < right; ++x) {
        if ((e0 | e1 | e2) >= 0) {
          const double unclamped = row_depth + slope_x * static_cast<double>(x - left);
          const float depth = static_cast<float>(std::clamp(unclamped, depths[0], depths[1]));
          if (depth > row[x]) {
            row[x] = depth;
            face_index_[y * width_ + x] = face;
          }
        }
        e0 += edges[0].step_x, e1 += edges[1].step_x, e2 += edges[2].step_x;
      }
      for (Edge& edge : edges) edge.value += edge.step_y;
    }
  }

 private:
  int64_t width_, height_;
  int32_t* face_index_;
  float* inverse_depth_;
};

void project(const Mesh& mesh, const MeshView& view, std::vector<Point>& points) {
  double to_pixels[3][4];
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) {
      double sum = 0;
      for (int k = 0; k < 3; ++k) sum += static_cast<double>(view.K[row * 3 + k]) * view.viewmat[k * 4 + column];
      to_pixels[row][column] = sum;
    }
  }
  points.resize(mesh.vertex_count);
  for (int64_t i = 0; i < mesh.vertex_count; ++i) {
    const float* vertex = mesh.vertices + 3 * i;
    const auto row = [&](const double* m) { return m[0] * vertex[0] + m[1] * vertex[1] + m[2] * vertex[2] + m[3]; };
    points[i] = {row(to_pixels[0]), row(to_pixels[1]), row(to_pixels[2])};
  }
}

bool is_finite(const Point& point) {
  return std::isfinite(point.x) && std::isfinite(point.y) && std::isfinite(point.z);
}

void draw_face(int64_t face, const Point corners[3], bool cull_backfaces, Workspace& workspace, DepthBuffer& buffer) {
  if (!is_finite(corners[0]) || !is_finite(corners[1]) || !is_finite(corners[2])) return;
  Point clipped[4];
  const int count = clip_near(corners, clipped);
  if (count == 0) return;
  EdgePlanes& planes = workspace.planes[face];
  if (!edge_planes(corners[0], corners[1], corners[2], planes)) return;
  Snapped snapped[4];
  double depths[2] = {std::numeric_limits<double>::infinity(), 0};
  for (int i = 0; i < count; ++i) {
    snapped[i] = snap(clipped[i]);
    depths[0] = std::min(depths[0], 1 / clipped[i].z);
    depths[1] = std::max(depths[1], 1 / clipped[i].z);
  }
  for (int i = 2; i < count; ++i) {
    // Seen from its front (counter-clockwise), a triangle has a negative area in pixels, where y points down.
    if (cull_backfaces && doubled_area(snapped[0], snapped[i - 1], snapped[i]) > 0) continue;
    buffer.draw(static_cast<int32_t>(face), snapped[0], snapped[i - 1], snapped[i], planes, depths);
  }
}

// Barycentrics of the visible triangles. Snapping may put a centre slightly outside: clamped, then normalised.
void resolve(const Workspace& workspace, const MeshView& view, const MeshFragmentBuffers& out) {
  for (int64_t y = 0; y < view.height; ++y) {
    for (int64_t x = 0; x < view.width; ++x) {
      const int64_t pixel = y * view.width + x;
      float* barycentric = out.barycentric + 3 * pixel;
      if (out.face_index[pixel] < 0) {
        std::fill_n(barycentric, 3, 0.0f);
        out.depth[pixel] = std::numeric_limits<float>::infinity();
        continue;
      }
      const auto& rows = workspace.planes[out.face_index[pixel]].rows;
      double weights[3], sum = 0;
      for (int i = 0; i < 3; ++i) {
        weights[i] = std::max(rows[i][0] * (x + 0.5) + rows[i][1] * (y + 0.5) + rows[i][2], 0.0);
        sum += weights[i];
      }
      for (int i = 0; i < 3; ++i) barycentric[i] = static_cast<float>(sum > 0 ? weights[i] / sum : 1.0 / 3);
      out.depth[pixel] = 1 / out.depth[pixel];
    }
  }
}

}  // namespace

void rasterize_mesh(const Mesh& mesh, const MeshView& view, bool cull_backfaces, const MeshFragmentBuffers& out) {
  thread_local Workspace workspace;  // kept between calls: fresh pages cost as much as the work
  project(mesh, view, workspace.points);
  workspace.planes.resize(mesh.face_count);
  DepthBuffer buffer(view, out);
  for (int64_t face = 0; face < mesh.face_count; ++face) {
    const int64_t* index = mesh.faces + 3 * face;
    const Point corners[3] = {workspace.points[index[0]], workspace.points[index[1]], workspace.points[index[2]]};
    draw_face(face, corners, cull_backfaces, workspace, buffer);
  }
  resolve(workspace, view, out);
}

void interpolate_mesh(const int32_t* face_index, const float* barycentric, int64_t pixel_count, const float* attributes,
                      const int64_t* corners, int channels, float* out) {
  for (int64_t pixel = 0; pixel < pixel_count; ++pixel) {
    float* row = out + pixel * channels;
    if (face_index[pixel] < 0) {
      std::fill_n(row, channels, 0.0f);
      continue;
    }
    const int64_t* index = corners + 3 * static_cast<int64_t>(face_index[pixel]);
    const float* weights = barycentric + 3 * pixel;
    const float* a = attributes + index[0] * channels;
    const float* b = attributes + index[1] * channels;
    const float* c = attributes + index[2] * channels;
    for (int i = 0; i < channels; ++i) row[i] = weights[0] * a[i] + weights[1] * b[i] + weights[2] * c[i];
  }
}

}  // namespace mien
