#include "mesh_align.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "mesh_align_surface.h"
#include "pool.h"

namespace mien {
namespace {

constexpr int kBlocks = 6 * 3;  // corner pairs (0,0) (0,1) (0,2) (1,1) (1,2) (2,2), each a symmetric 2x2 block
constexpr int kSums = kBlocks + 6;

struct Residual {
  int32_t x, y, face;
  float weight;
  Color color;
};

struct Workspace {
  std::vector<Residual> residuals;
  int left, top, columns, rows;             // box of the residuals
  std::vector<float> smooth, rows_of_sums;  // [rows,columns,4] weighted colours and weights, then smoothed
  std::vector<uint8_t> touched;             // [f]
  int64_t cell_of(const Residual& one) const { return static_cast<int64_t>(one.y - top) * columns + (one.x - left); }
  std::vector<float> sums;      // [f, kSums]
  std::vector<int32_t> hit;     // triangles with sums
  std::vector<int32_t> row_of;  // vertex -> row, -1
  std::vector<int32_t> vertices;
  std::vector<float> screen, product, force;  // [rows,2,p], [rows,2,p], [rows,2]
};

void add_pixel(float* sums, const float* weights, const float gradient[2][3], const Color& residual, float weight) {
  float g[3] = {}, force[2] = {};
  for (int c = 0; c < 3; ++c) {
    g[0] += gradient[0][c] * gradient[0][c];
    g[1] += gradient[0][c] * gradient[1][c];
    g[2] += gradient[1][c] * gradient[1][c];
    force[0] += gradient[0][c] * residual.c[c];
    force[1] += gradient[1][c] * residual.c[c];
  }
  int at = 0;
  for (int k = 0; k < 3; ++k) {
    for (int l = k; l < 3; ++l) {
      const float share = weight * weights[k] * weights[l];
      for (int i = 0; i < 3; ++i) sums[at++] += share * g[i];
    }
  }
  for (int k = 0; k < 3; ++k)
    for (int i = 0; i < 2; ++i) sums[at++] += weight * weights[k] * force[i];
}

// Derivatives of a vertex's pixel position by the parameters.
void screen_jacobian(const Mesh& mesh, const MeshView& view, int64_t vertex, const float* jacobian, int parameters,
                     float* out) {
  const float* position = mesh.vertices + 3 * vertex;
  float in_camera[3];
  for (int row = 0; row < 3; ++row) {
    const float* m = view.viewmat + 4 * row;
    in_camera[row] = m[0] * position[0] + m[1] * position[1] + m[2] * position[2] + m[3];
  }
  const float inverse = 1 / std::max(in_camera[2], static_cast<float>(kMeshNearPlane));
  for (int row = 0; row < 2; ++row) {
    const float focal = view.K[4 * row] * inverse, shift = -focal * in_camera[row] * inverse;
    float by_world[3];
    for (int axis = 0; axis < 3; ++axis)
      by_world[axis] = focal * view.viewmat[4 * row + axis] + shift * view.viewmat[8 + axis];
    const float* x = jacobian + 3 * vertex * parameters;
    const float *y = x + parameters, *z = y + parameters;
    float* target = out + static_cast<int64_t>(row) * parameters;
    for (int i = 0; i < parameters; ++i) target[i] = by_world[0] * x[i] + by_world[1] * y[i] + by_world[2] * z[i];
  }
}

// Lists the vertices of the triangles that were hit.
void list_vertices(const Mesh& mesh, Workspace& w) {
  w.row_of.assign(mesh.vertex_count, -1);
  w.vertices.clear();
  for (const int32_t face : w.hit) {
    for (int k = 0; k < 3; ++k) {
      const int64_t vertex = mesh.faces[3 * static_cast<int64_t>(face) + k];
      if (w.row_of[vertex] >= 0) continue;
      w.row_of[vertex] = static_cast<int32_t>(w.vertices.size());
      w.vertices.push_back(static_cast<int32_t>(vertex));
    }
  }
}

// Sums of triangles -> A J and b of every listed vertex; A has entries only between neighbours.
void gather_products(const Mesh& mesh, int parameters, Workspace& w) {
  const int64_t row_size = 2 * static_cast<int64_t>(parameters);
  w.product.assign(w.vertices.size() * row_size, 0.0f);
  w.force.assign(w.vertices.size() * 2, 0.0f);
  static constexpr int kBlockOf[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
  for (const int32_t face : w.hit) {
    const float* sums = w.sums.data() + static_cast<int64_t>(face) * kSums;
    for (int k = 0; k < 3; ++k) {
      const int64_t row = w.row_of[mesh.faces[3 * static_cast<int64_t>(face) + k]];
      float *product_x = w.product.data() + row * row_size, *product_y = product_x + parameters;
      for (int l = 0; l < 3; ++l) {
        const float* block = sums + 3 * kBlockOf[k][l];
        const int64_t other = w.row_of[mesh.faces[3 * static_cast<int64_t>(face) + l]];
        const float *x = w.screen.data() + other * row_size, *y = x + parameters;
        const float xx = block[0], xy = block[1], yy = block[2];
        for (int i = 0; i < parameters; ++i) {
          product_x[i] += xx * x[i] + xy * y[i];
          product_y[i] += xy * x[i] + yy * y[i];
        }
      }
      w.force[2 * row] += sums[kBlocks + 2 * k];
      w.force[2 * row + 1] += sums[kBlocks + 2 * k + 1];
    }
  }
}

// J^T A J and J^T b, times `scale`.
void project_sums(const Mesh& mesh, const MeshView& view, const float* jacobian, int parameters, double scale,
                  Workspace& w, const AlignBuffers& out) {
  const int64_t row_size = 2 * static_cast<int64_t>(parameters);
  list_vertices(mesh, w);
  w.screen.resize(w.vertices.size() * row_size);
  for (size_t row = 0; row < w.vertices.size(); ++row)
    screen_jacobian(mesh, view, w.vertices[row], jacobian, parameters, w.screen.data() + row * row_size);
  gather_products(mesh, parameters, w);
  std::fill_n(out.hessian, static_cast<int64_t>(parameters) * parameters, 0.0f);
  std::fill_n(out.gradient, parameters, 0.0f);
  for (size_t row = 0; row < 2 * w.vertices.size(); ++row) {
    const float *screen = w.screen.data() + row * parameters, *product = w.product.data() + row * parameters;
    const float force = w.force[row];
    for (int i = 0; i < parameters; ++i) {
      const float left = screen[i];
      if (left == 0) continue;
      out.gradient[i] += left * force;
      float* target = out.hessian + static_cast<int64_t>(i) * parameters;
      for (int j = i; j < parameters; ++j) target[j] += left * product[j];
    }
  }
  for (int i = 0; i < parameters; ++i) {
    out.gradient[i] = static_cast<float>(out.gradient[i] * scale);
    for (int j = i; j < parameters; ++j) {
      const float value = static_cast<float>(out.hessian[static_cast<int64_t>(i) * parameters + j] * scale);
      out.hessian[static_cast<int64_t>(i) * parameters + j] = value;
      out.hessian[static_cast<int64_t>(j) * parameters + i] = value;
    }
  }
}

void collect_residuals(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                       const AlignOptions& options, const DrawnMesh& drawn, Workspace& w) {
  w.residuals.clear();
  int right = 0, bottom = 0;
  w.left = frame.view.width, w.top = frame.view.height;
  for_pixels(
      mesh, surface, frame, options, drawn,
      [&](int64_t pixel, int32_t face, const float*, const SurfacePoint&, const Sample& sample, const Color& light) {
        const int x = static_cast<int>(pixel % frame.view.width), y = static_cast<int>(pixel / frame.view.width);
        Residual one{x, y, face, frame.mask[pixel] * sample.weight, {}};
        for (int c = 0; c < 3; ++c) one.color.c[c] = frame.image[3 * pixel + c] - sample.color.c[c] * light.c[c];
        w.residuals.push_back(one);
        w.left = std::min(w.left, x), w.top = std::min(w.top, y);
        right = std::max(right, x + 1), bottom = std::max(bottom, y + 1);
      });
  w.columns = std::max(right - w.left, 0), w.rows = std::max(bottom - w.top, 0);
}

// Running sums over 2 radius + 1 of `count` cells of four numbers, `stride` numbers apart.
void box_sums(const float* in, float* out, int count, int64_t stride, int radius) {
  float sum[4] = {};
  for (int i = -radius; i < count; ++i) {
    const int enters = i + radius, leaves = i - radius - 1;
    for (int c = 0; c < 4; ++c) {
      if (enters < count) sum[c] += in[enters * stride + c];
      if (leaves >= 0) sum[c] -= in[leaves * stride + c];
      if (i >= 0) out[i * stride + c] = sum[c];
    }
  }
}

// The residuals' weighted mean around each of them: two box filters in a row, which make a triangle.
void smooth_residuals(HighPass high_pass, const AlignOptions& options, Workspace& w) {
  const int radius = std::min(high_pass.radius, std::max(w.columns, w.rows));  // a larger window covers no more
  const size_t size = 4 * static_cast<size_t>(w.columns) * w.rows;
  w.smooth.assign(size, 0.0f);
  w.rows_of_sums.resize(size);
  const float inverse_variance = 1 / (options.sigma * options.sigma);
  for (const Residual& one : w.residuals) {
    float* cell = w.smooth.data() + 4 * w.cell_of(one);
    const float fade = fading(squared_norm(one.color) * inverse_variance, options), weight = one.weight * fade * fade;
    for (int c = 0; c < 3; ++c) cell[c] = weight * one.color.c[c];
    cell[3] = weight;
  }
  const int64_t stride = 4 * static_cast<int64_t>(w.columns);
  for (int turn = 0; turn < 2; ++turn) {
    for (int y = 0; y < w.rows; ++y)
      box_sums(w.smooth.data() + y * stride, w.rows_of_sums.data() + y * stride, w.columns, 4, radius);
    for (int x = 0; x < w.columns; ++x)
      box_sums(w.rows_of_sums.data() + 4 * x, w.smooth.data() + 4 * x, w.rows, stride, radius);
  }
  for (size_t cell = 0; cell < size; cell += 4) {
    const float weight = w.smooth[cell + 3];
    for (int c = 0; c < 3; ++c) w.smooth[cell + c] = weight > 1e-3f ? w.smooth[cell + c] / weight : 0.0f;
  }
}

// Sets the sums and marks of triangles back to zero, also if a call ends early for lack of memory.
struct CleanTriangles {
  Workspace& w;

  CleanTriangles(Workspace& workspace, const Mesh& mesh) : w(workspace) {
    w.sums.resize(static_cast<size_t>(mesh.face_count) * kSums, 0.0f);
    w.touched.resize(mesh.face_count, 0);
    w.hit.reserve(std::min<size_t>(w.residuals.size(), mesh.face_count));
  }
  CleanTriangles(const CleanTriangles&) = delete;
  CleanTriangles& operator=(const CleanTriangles&) = delete;
  ~CleanTriangles() {
    for (const int32_t face : w.hit) {
      std::fill_n(w.sums.data() + static_cast<int64_t>(face) * kSums, kSums, 0.0f);
      w.touched[face] = 0;
    }
    w.hit.clear();
  }
};

Workspace& own_workspace() {
  thread_local Workspace workspace;  // kept between calls: fresh pages cost as much as the work
  return workspace;
}

}  // namespace

AlignResult align_mesh(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                       const AlignOptions& options, HighPass high_pass, const float* jacobian, int parameters,
                       const AlignBuffers& out) {
  Workspace& w = own_workspace();
  DrawnMesh& drawn = own_drawing();
  draw(mesh, frame.view, drawn);
  collect_residuals(mesh, surface, frame, options, drawn, w);
  if (high_pass.radius > 0) smooth_residuals(high_pass, options, w);
  const CleanTriangles clean(w, mesh);
  const int width = frame.view.width;
  const int64_t values = 3 * static_cast<int64_t>(width) * frame.view.height;
  if (out.residual) std::fill_n(out.residual, values, std::numeric_limits<float>::quiet_NaN());
  if (out.smooth) std::fill_n(out.smooth, values, 0.0f);
  const float inverse_variance = 1 / (options.sigma * options.sigma);
  double cost = 0, total = 0;
  for (const Residual& one : w.residuals) {
    Color residual;
    const float* smooth = w.smooth.data() + 4 * w.cell_of(one);
    for (int c = 0; c < 3; ++c) residual.c[c] = one.color.c[c] - (high_pass.radius > 0 ? smooth[c] : 0);
    const float squared = squared_norm(residual) * inverse_variance, fade = fading(squared, options);
    total += one.weight;
    cost += one.weight * squared * fade;
    const int64_t pixel = static_cast<int64_t>(one.y) * width + one.x;
    if (out.residual) std::copy_n(residual.c, 3, out.residual + 3 * pixel);
    if (out.smooth && high_pass.radius > 0) std::copy_n(smooth, 3, out.smooth + 3 * pixel);
    if (!out.hessian) continue;
    const float* seen = frame.image + 3 * pixel;
    float gradient[2][3];
    for (int c = 0; c < 3; ++c) {
      gradient[0][c] = 0.5f * (seen[3 + c] - seen[c - 3]);
      gradient[1][c] = 0.5f * (seen[3 * width + c] - seen[c - 3 * width]);
    }
    if (w.touched[one.face] == 0) w.hit.push_back(one.face);
    w.touched[one.face] = 1;
    add_pixel(w.sums.data() + static_cast<int64_t>(one.face) * kSums, drawn.barycentric.data() + 3 * pixel, gradient,
              residual, one.weight * fade * fade * inverse_variance);
  }
  const double scale = total > 0 ? 1 / total : 0;
  if (out.hessian) project_sums(mesh, frame.view, jacobian, parameters, scale, w, out);
  return {cost * scale, total};
}

namespace {

constexpr float kDepthTolerance = 0.0005f;  // metres: a texel is hidden if it is this far behind the visible surface

}  // namespace

void bake_texture(const Mesh& mesh, const TexturedSurface& surface, const AlignFrame& frame,
                  const AlignOptions& options, const BakeTexels& texels, const BakeSums& out) {
  DrawnMesh& drawn = own_drawing();
  draw(mesh, frame.view, drawn);
  float eye[3];
  camera_position(frame.view.viewmat, eye);
  const MeshView& view = frame.view;
  const float least = options.outlier * options.outlier, inverse_variance = 1 / (options.sigma * options.sigma);
  const auto add_texel = [&](int64_t texel) {
    const int32_t face = texels.face[texel];
    if (face < 0 || !surface.used[face]) return;
    const SurfacePoint point =
        surface_point(mesh, frame, eye, mesh.faces + 3 * static_cast<int64_t>(face), texels.barycentric + 3 * texel);
    if (point.cosine < options.least_cosine) return;
    float in_camera[3];
    for (int row = 0; row < 3; ++row) {
      const float* m = view.viewmat + 4 * row;
      in_camera[row] = m[0] * point.position[0] + m[1] * point.position[1] + m[2] * point.position[2] + m[3];
    }
    if (in_camera[2] < kMeshNearPlane) return;
    const float x = view.K[0] * in_camera[0] / in_camera[2] + view.K[2] - 0.5f;
    const float y = view.K[4] * in_camera[1] / in_camera[2] + view.K[5] - 0.5f;
    if (!(x >= 0 && y >= 0 && x < view.width - 1 && y < view.height - 1)) return;
    const int x0 = static_cast<int>(x), y0 = static_cast<int>(y);
    const int64_t nearest = static_cast<int64_t>(std::lround(y)) * view.width + std::lround(x);
    // The depth that a slope gains within a pixel does not hide it.
    const float slope = std::sqrt(std::max(1 - point.cosine * point.cosine, 0.0f)) / std::max(point.cosine, 0.1f);
    const float tolerance = kDepthTolerance + in_camera[2] / view.K[0] * slope;
    if (in_camera[2] > drawn.depth[nearest] + tolerance) return;
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
  };
  parallel_for(surface.texture_height, [&, columns = int64_t{surface.texture_width}](int64_t row) {
    for (int64_t texel = row * columns; texel < (row + 1) * columns; ++texel) add_texel(texel);
  });
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
