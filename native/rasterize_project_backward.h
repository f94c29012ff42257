// Backward projection: from the moments of each Gaussian to the gradients of its parameters and of the view.
#pragma once

#include "rasterize_geometry.h"

namespace {

struct GaussianGrad {
  F mean[3], quat[4], scale[3], opacity, mean2d[2], color[3];
};

// The 2D part. With the variance V of x given y, the slope m and the variance C of y: dL/dV, dL/dm / C and dL/dC where
// V and m are held.
struct ScreenGrad {
  F x, y, slope;
  F variance_across, slope_over_yy, variance_y;
};

MIEN_INLINE ScreenGrad screen_gradient(const Projection& p, const F* moments) {
  // The moments are of the roots of the exponent's two parts (TileRoots).
  const F inverse_yy = 1.0f / p.yy, sharpness = p.yy / p.determinant;
  const F by_x = square_root(sharpness * (1 / kHalfLog2E)), by_y = square_root(inverse_yy * (1 / kHalfLog2E));
  const F mx = moments[4], my = moments[5], mxx = moments[6], mxy = moments[7], myy = moments[8];
  ScreenGrad s;
  s.slope = p.xy * inverse_yy;
  s.x = by_x * mx;
  s.y = by_y * my - s.slope * s.x;
  s.variance_across = (0.5f / kHalfLog2E) * sharpness * mxx;
  s.slope_over_yy = by_x * by_y * mxy;
  s.variance_y = (0.5f / kHalfLog2E) * inverse_yy * myy;
  return s;
}

MIEN_INLINE void quaternion_gradient(const Rotation& r, const F* g, F* out) {
  const F w = 2.0f * (r.x * (g[7] - g[5]) + r.y * (g[2] - g[6]) + r.z * (g[3] - g[1]));
  const F x = 2.0f * (r.y * (g[1] + g[3]) + r.z * (g[2] + g[6]) + r.w * (g[7] - g[5])) - 4.0f * r.x * (g[4] + g[8]);
  const F y = 2.0f * (r.x * (g[1] + g[3]) + r.z * (g[5] + g[7]) + r.w * (g[2] - g[6])) - 4.0f * r.y * (g[0] + g[8]);
  const F z = 2.0f * (r.x * (g[2] + g[6]) + r.y * (g[5] + g[7]) + r.w * (g[3] - g[1])) - 4.0f * r.z * (g[0] + g[4]);
  const F along = w * r.w + x * r.x + y * r.y + z * r.z;  // the length of a quaternion has no effect
  out[0] = (w - along * r.w) * r.inverse_length;
  out[1] = (x - along * r.x) * r.inverse_length;
  out[2] = (y - along * r.y) * r.inverse_length;
  out[3] = (z - along * r.z) * r.inverse_length;
}

// Adds to out.mean (camera part rotated back), out.quat, out.scale and the view's sums.
MIEN_INLINE void geometry_gradient(const Projection& p, const View& view, const F* mean, const F* scale,
                                   const ScreenGrad& s, GaussianGrad& out, F* view_sums) {
  F du[6], dn[6] = {}, dr[9];
  for (int column = 0; column < 3; ++column) {
    // The rows of U are x and y; V = |x|^2 - m (x . y) up to the dilation, and m = x . y / C.
    const F y = p.u[3 + column], across = p.u[column] - s.slope * y;
    du[column] = 2.0f * s.variance_across * across + s.slope_over_yy * y;
    du[3 + column] = 2.0f * s.variance_y * y + s.slope_over_yy * across - s.slope * du[column];
  }
  const F* r = p.rotation.m;
  for (int column = 0; column < 3; ++column) {
    F along{};
    for (int row = 0; row < 3; ++row) {
      const F dm = p.n[row] * du[column] + p.n[3 + row] * du[3 + column];  // d (R S)
      along = along + dm * r[3 * row + column];
      dr[3 * row + column] = dm * scale[column];
      const F m = r[3 * row + column] * scale[column];
      dn[row] = dn[row] + du[column] * m;
      dn[3 + row] = dn[3 + row] + du[3 + column] * m;
    }
    out.scale[column] = along;
  }
  quaternion_gradient(p.rotation, dr, out.quat);

  const float* t = view.rotation;
  const F j0 = dn[0] * t[0] + dn[1] * t[1] + dn[2] * t[2], j2 = dn[0] * t[6] + dn[1] * t[7] + dn[2] * t[8];
  const F j4 = dn[3] * t[3] + dn[4] * t[4] + dn[5] * t[5], j5 = dn[3] * t[6] + dn[4] * t[7] + dn[5] * t[8];
  const F iz = p.inverse_depth, one = set1(1.0f), two = set1(2.0f);
  // j[2] = -fx x / z^2 where free, and -fx bound / z where clamped.
  const F camera_x = p.j[0] * s.x - keep(p.free_x, p.j[0] * iz * j2);
  const F camera_y = p.j[4] * s.y - keep(p.free_y, p.j[4] * iz * j5);
  const F camera_z = -p.j[0] * p.tan_x * s.x - p.j[4] * p.tan_y * s.y -
                     iz * (p.j[0] * j0 + p.j[4] * j4 + select(p.free_x, two, one) * p.j[2] * j2 +
                           select(p.free_y, two, one) * p.j[5] * j5);
  const F camera[3] = {camera_x, camera_y, camera_z};
  for (int column = 0; column < 3; ++column) {
    out.mean[column] = t[column] * camera_x + t[3 + column] * camera_y + t[6 + column] * camera_z;
    for (int row = 0; row < 3; ++row)
      view_sums[3 * row + column] = view_sums[3 * row + column] + camera[row] * mean[column];
    view_sums[column] = view_sums[column] + p.j[0] * dn[column];
    view_sums[3 + column] = view_sums[3 + column] + p.j[4] * dn[3 + column];
    view_sums[6 + column] = view_sums[6 + column] + p.j[2] * dn[column] + p.j[5] * dn[3 + column];
    view_sums[9 + column] = view_sums[9 + column] + camera[column];
  }
  view_sums[12] = view_sums[12] + s.x * p.tan_x + iz * (j0 - p.clamped_x * j2);
  view_sums[13] = view_sums[13] + s.y * p.tan_y + iz * (j4 - p.clamped_y * j5);
  view_sums[14] = view_sums[14] + s.x;
  view_sums[15] = view_sums[15] + s.y;
}

// The spherical harmonics: writes their gradient, adds to out.mean and the view's sums.
template <int COUNT>
MIEN_INLINE void color_gradient(const GaussianArrays& g, const View& view, int64_t i, int valid, const F* mean,
                                GaussianGrad& out, float* grad_sh, F* view_sums) {
  F inverse_distance, coefficients[3 * COUNT], basis[COUNT], gradients[3 * COUNT];
  load_columns<3 * COUNT>(g.sh + 3 * COUNT * i, 3 * COUNT, valid, coefficients);
  const V3 d = view_direction(view, mean, &inverse_distance);
  sh_basis<COUNT>(d, basis);
  F c[3] = {set1(0.5f), set1(0.5f), set1(0.5f)};
  for (int j = 0; j < COUNT; ++j)
    for (int channel = 0; channel < 3; ++channel) c[channel] = c[channel] + basis[j] * coefficients[3 * j + channel];
  for (int channel = 0; channel < 3; ++channel) out.color[channel] = keep(less(F{}, c[channel]), out.color[channel]);
  F weight[COUNT];
  for (int j = 0; j < COUNT; ++j) {
    weight[j] = F{};
    for (int channel = 0; channel < 3; ++channel) {
      gradients[3 * j + channel] = basis[j] * out.color[channel];
      weight[j] = weight[j] + coefficients[3 * j + channel] * out.color[channel];
    }
  }
  store_columns<3 * COUNT>(grad_sh + 3 * COUNT * i, 3 * COUNT, valid, gradients);
  if constexpr (COUNT > 1) {
    const V3 e = sh_basis_backward<COUNT>(d, weight);
    const F along = e.x * d.x + e.y * d.y + e.z * d.z;
    const F mean_grad[3] = {(e.x - along * d.x) * inverse_distance, (e.y - along * d.y) * inverse_distance,
                            (e.z - along * d.z) * inverse_distance};
    const float *t = view.translation, *r = view.rotation;
    for (int column = 0; column < 3; ++column) {
      out.mean[column] = out.mean[column] + mean_grad[column];
      // The camera's centre is -R^T t.
      for (int row = 0; row < 3; ++row) {
        view_sums[3 * row + column] = view_sums[3 * row + column] + t[row] * mean_grad[column];
        view_sums[9 + row] = view_sums[9 + row] + r[3 * row + column] * mean_grad[column];
      }
    }
  }
}

// Sums the moments of each lane's slots, in their order; false if there are none.
MIEN_INLINE bool gather_moments(int64_t i, int valid, const uint32_t* begins, const Moments* slots, F* moments) {
  alignas(64) float buffer[W][12];
  F4 size{};
  for (int lane = 0; lane < W; ++lane) {
    F4 total[3] = {};
    const uint32_t end = lane < valid ? begins[i + lane + 1] : 0;
    for (uint32_t slot = lane < valid ? begins[i + lane] : 0; slot < end; ++slot) {
      F4 from[3];
      memcpy(from, &slots[slot], sizeof from);
      for (int j = 0; j < 3; ++j) total[j] = total[j] + from[j];
    }
    memcpy(buffer[lane], total, sizeof total);
    for (int j = 0; j < 3; ++j) size = size + total[j] * total[j];
  }
  load_columns<9>(buffer[0], 12, W, moments);
  return !(size[0] + size[1] + size[2] + size[3] == 0.0f);
}

MIEN_INLINE void clear_group(const GaussianGradients& out, int sh_count, int64_t i, int valid) {
  memset(out.means + 3 * i, 0, sizeof(float) * 3 * valid);
  memset(out.quats + 4 * i, 0, sizeof(float) * 4 * valid);
  memset(out.scales + 3 * i, 0, sizeof(float) * 3 * valid);
  memset(out.opacities + i, 0, sizeof(float) * valid);
  memset(out.means2d + 2 * i, 0, sizeof(float) * 2 * valid);
  memset(out.sh + 3 * sh_count * i, 0, sizeof(float) * 3 * sh_count * valid);
}

MIEN_INLINE void project_backward_group(const GaussianArrays& g, const View& view, int64_t i, int valid,
                                        const F* moments, const GaussianGradients& out, F* view_sums) {
  F in[11];
  load_columns<3>(g.means + 3 * i, 3, valid, in);
  load_columns<4>(g.quats + 4 * i, 4, valid, in + 3);
  load_columns<3>(g.scales + 3 * i, 3, valid, in + 7);
  load_columns<1>(g.opacities + i, 1, valid, in + 10);
  const Projection p = project_lanes(view, in, in + 3, in + 7);
  const ScreenGrad screen = screen_gradient(p, moments);
  GaussianGrad grad;
  grad.color[0] = moments[0];
  grad.color[1] = moments[1];
  grad.color[2] = moments[2];
  grad.mean2d[0] = screen.x;
  grad.mean2d[1] = screen.y;
  grad.opacity = moments[3] / maximum(in[10], set1(1e-30f));
  geometry_gradient(p, view, in, in + 7, screen, grad, view_sums);
  if (g.sh_count == 1) color_gradient<1>(g, view, i, valid, in, grad, out.sh, view_sums);
  if (g.sh_count == 4) color_gradient<4>(g, view, i, valid, in, grad, out.sh, view_sums);
  if (g.sh_count == 9) color_gradient<9>(g, view, i, valid, in, grad, out.sh, view_sums);
  if (g.sh_count == 16) color_gradient<16>(g, view, i, valid, in, grad, out.sh, view_sums);
  store_columns<3>(out.means + 3 * i, 3, valid, grad.mean);
  store_columns<4>(out.quats + 4 * i, 4, valid, grad.quat);
  store_columns<3>(out.scales + 3 * i, 3, valid, grad.scale);
  store_columns<1>(out.opacities + i, 1, valid, &grad.opacity);
  store_columns<2>(out.means2d + 2 * i, 2, valid, grad.mean2d);
}

void project_backward(const GaussianArrays& g, const View& view, int64_t first, int64_t last,
                      const uint32_t* slot_begins, const Moments* slots, const GaussianGradients& out,
                      float* view_gradient) {
  F view_sums[kViewGradients] = {};
  for (int64_t i = first; i < last; i += W) {
    const int valid = last - i < W ? (int)(last - i) : W;
    F moments[9];
    if (gather_moments(i, valid, slot_begins, slots, moments)) {
      project_backward_group(g, view, i, valid, moments, out, view_sums);
    } else {
      clear_group(out, g.sh_count, i, valid);
    }
  }
  for (int j = 0; j < kViewGradients; ++j) view_gradient[j] = sum(view_sums[j]);
}

}  // namespace
