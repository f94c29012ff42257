// W Gaussians at a time, one per lane: from means, rotations and scales to splats. Shared by both directions.
#pragma once

#include "rasterize_kernels.h"
#include "simd_columns.h"

namespace {

using namespace mien;

constexpr float kHalfLog2E = 0.72134752044f;

struct V3 {
  F x, y, z;
};

// R of a wxyz quaternion, row-major, with the normalised quaternion and 1 / its length (0 for a zero quaternion).
struct Rotation {
  F m[9];
  F w, x, y, z, inverse_length;
};

MIEN_INLINE Rotation rotation_of(const F* quat) {
  const F squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
  const M there = less(set1(1e-24f), squared);
  Rotation r;
  r.inverse_length = keep(there, 1.0f / square_root(select(there, squared, set1(1.0f))));
  r.w = quat[0] * r.inverse_length;
  r.x = quat[1] * r.inverse_length;
  r.y = quat[2] * r.inverse_length;
  r.z = quat[3] * r.inverse_length;
  r.m[0] = 1.0f - 2.0f * (r.y * r.y + r.z * r.z);
  r.m[1] = 2.0f * (r.x * r.y - r.w * r.z);
  r.m[2] = 2.0f * (r.x * r.z + r.w * r.y);
  r.m[3] = 2.0f * (r.x * r.y + r.w * r.z);
  r.m[4] = 1.0f - 2.0f * (r.x * r.x + r.z * r.z);
  r.m[5] = 2.0f * (r.y * r.z - r.w * r.x);
  r.m[6] = 2.0f * (r.x * r.z - r.w * r.y);
  r.m[7] = 2.0f * (r.y * r.z + r.w * r.x);
  r.m[8] = 1.0f - 2.0f * (r.x * r.x + r.y * r.y);
  return r;
}

// Everything between the inputs and the 2D Gaussian. U = J T R S is 2x3 and the covariance U U^T + dilation.
struct Projection {
  V3 camera;        // the mean in camera space
  F inverse_depth;  // 1 / z
  M in_front;       // lanes behind the near plane hold numbers of a stand-in
  F tan_x, tan_y;   // x / z, y / z
  F clamped_x, clamped_y;
  M free_x, free_y;  // where the clamp does not act
  F j[6];            // [2, 3]
  F n[6];            // J T, [2, 3]
  Rotation rotation;
  F u[6];        // [2, 3]
  F xx, xy, yy;  // covariance, pixels^2
  F determinant;
  F x, y;  // centre, pixels
};

MIEN_INLINE V3 transform(const View& view, const F* mean) {
  const float* r = view.rotation;
  const float* t = view.translation;
  return {r[0] * mean[0] + r[1] * mean[1] + r[2] * mean[2] + t[0],
          r[3] * mean[0] + r[4] * mean[1] + r[5] * mean[2] + t[1],
          r[6] * mean[0] + r[7] * mean[1] + r[8] * mean[2] + t[2]};
}

MIEN_INLINE void clamp_direction(Projection& p, const View& view) {
  const float margin_x = kFovMargin * 0.5f * view.width / view.fx, margin_y = kFovMargin * 0.5f * view.height / view.fy;
  const F left = set1(-view.cx / view.fx - margin_x), right = set1((view.width - view.cx) / view.fx + margin_x);
  const F top = set1(-view.cy / view.fy - margin_y), bottom = set1((view.height - view.cy) / view.fy + margin_y);
  p.clamped_x = clamp(p.tan_x, left, right);
  p.clamped_y = clamp(p.tan_y, top, bottom);
  p.free_x = both(less_equal(left, p.tan_x), less_equal(p.tan_x, right));
  p.free_y = both(less_equal(top, p.tan_y), less_equal(p.tan_y, bottom));
}

MIEN_INLINE Projection project_lanes(const View& view, const F* mean, const F* quat, const F* scale) {
  Projection p;
  p.camera = transform(view, mean);
  p.in_front = less(set1(kNear), p.camera.z);
  p.camera.x = keep(p.in_front, p.camera.x);
  p.camera.y = keep(p.in_front, p.camera.y);
  p.inverse_depth = 1.0f / select(p.in_front, p.camera.z, set1(1.0f));
  p.tan_x = p.camera.x * p.inverse_depth;
  p.tan_y = p.camera.y * p.inverse_depth;
  clamp_direction(p, view);
  p.x = view.fx * p.tan_x + view.cx;
  p.y = view.fy * p.tan_y + view.cy;
  p.j[0] = view.fx * p.inverse_depth;
  p.j[1] = F{};
  p.j[2] = -p.j[0] * p.clamped_x;
  p.j[3] = F{};
  p.j[4] = view.fy * p.inverse_depth;
  p.j[5] = -p.j[4] * p.clamped_y;
  for (int column = 0; column < 3; ++column) {
    p.n[column] = p.j[0] * view.rotation[column] + p.j[2] * view.rotation[6 + column];
    p.n[3 + column] = p.j[4] * view.rotation[3 + column] + p.j[5] * view.rotation[6 + column];
  }
  p.rotation = rotation_of(quat);
  const F* r = p.rotation.m;
  for (int column = 0; column < 3; ++column) {
    p.u[column] = (p.n[0] * r[column] + p.n[1] * r[3 + column] + p.n[2] * r[6 + column]) * scale[column];
    p.u[3 + column] = (p.n[3] * r[column] + p.n[4] * r[3 + column] + p.n[5] * r[6 + column]) * scale[column];
  }
  const F* u = p.u;
  const F xx = u[0] * u[0] + u[1] * u[1] + u[2] * u[2], yy = u[3] * u[3] + u[4] * u[4] + u[5] * u[5];
  p.xy = u[0] * u[3] + u[1] * u[4] + u[2] * u[5];
  // The determinant without the dilation is |row 0 x row 1|^2: unlike xx yy - xy^2 it does not cancel.
  const F cx = u[1] * u[5] - u[2] * u[4], cy = u[2] * u[3] - u[0] * u[5], cz = u[0] * u[4] - u[1] * u[3];
  p.determinant = (cx * cx + cy * cy + cz * cz) + kDilation * (xx + yy) + kDilation * kDilation;
  p.xx = xx + kDilation;
  p.yy = yy + kDilation;
  return p;
}

// The unit vector from the camera's centre, and 1 / the distance (0 at the centre itself).
MIEN_INLINE V3 view_direction(const View& view, const F* mean, F* inverse_distance) {
  const float* r = view.rotation;
  const float* t = view.translation;
  V3 d;
  d.x = mean[0] + (r[0] * t[0] + r[3] * t[1] + r[6] * t[2]);
  d.y = mean[1] + (r[1] * t[0] + r[4] * t[1] + r[7] * t[2]);
  d.z = mean[2] + (r[2] * t[0] + r[5] * t[1] + r[8] * t[2]);
  const F squared = d.x * d.x + d.y * d.y + d.z * d.z;
  const M there = less(set1(1e-24f), squared);
  *inverse_distance = keep(there, 1.0f / square_root(select(there, squared, set1(1.0f))));
  return {d.x * *inverse_distance, d.y * *inverse_distance, d.z * *inverse_distance};
}

// Real spherical harmonics at unit directions; the constants are those of projection.py.
template <int COUNT>
MIEN_INLINE void sh_basis(V3 d, F* basis) {
  const F x = d.x, y = d.y, z = d.z;
  basis[0] = set1(0.28209479177387814f);
  if constexpr (COUNT > 1) {
    basis[1] = -0.4886025119029199f * y;
    basis[2] = 0.4886025119029199f * z;
    basis[3] = -0.4886025119029199f * x;
  }
  if constexpr (COUNT > 4) {
    basis[4] = 1.0925484305920792f * x * y;
    basis[5] = -1.0925484305920792f * y * z;
    basis[6] = 0.31539156525252005f * (2.0f * z * z - x * x - y * y);
    basis[7] = -1.0925484305920792f * x * z;
    basis[8] = 0.5462742152960396f * (x * x - y * y);
  }
  if constexpr (COUNT > 9) {
    basis[9] = -0.5900435899266435f * y * (3.0f * x * x - y * y);
    basis[10] = 2.890611442640554f * x * y * z;
    basis[11] = -0.4570457994644658f * y * (4.0f * z * z - x * x - y * y);
    basis[12] = 0.3731763325901154f * z * (2.0f * z * z - 3.0f * x * x - 3.0f * y * y);
    basis[13] = -0.4570457994644658f * x * (4.0f * z * z - x * x - y * y);
    basis[14] = 1.445305721320277f * z * (x * x - y * y);
    basis[15] = -0.5900435899266435f * x * (x * x - 3.0f * y * y);
  }
}

// sum_j weight[j] * d basis[j] / d direction.
template <int COUNT>
MIEN_INLINE V3 sh_basis_backward(V3 d, const F* weight) {
  const F x = d.x, y = d.y, z = d.z;
  V3 g{F{}, F{}, F{}};
  if constexpr (COUNT > 1) {
    g.y = -0.4886025119029199f * weight[1];
    g.z = 0.4886025119029199f * weight[2];
    g.x = -0.4886025119029199f * weight[3];
  }
  if constexpr (COUNT > 4) {
    const F a = 1.0925484305920792f * weight[4], b = -1.0925484305920792f * weight[5];
    const F c = 0.6307831305050401f * weight[6], e = -1.0925484305920792f * weight[7];
    const F f = 1.0925484305920792f * weight[8];
    g.x = g.x + a * y - c * x + e * z + f * x;
    g.y = g.y + a * x + b * z - c * y - f * y;
    g.z = g.z + b * y + 2.0f * c * z + e * x;
  }
  if constexpr (COUNT > 9) {
    const F a = -0.5900435899266435f * weight[9], b = 2.890611442640554f * weight[10];
    const F c = -0.4570457994644658f * weight[11], e = 0.3731763325901154f * weight[12];
    const F f = -0.4570457994644658f * weight[13], h = 1.445305721320277f * weight[14];
    const F k = -0.5900435899266435f * weight[15];
    const F x2 = x * x, y2 = y * y, z2 = z * z;
    g.x = g.x + a * 6.0f * x * y + b * y * z - c * 2.0f * x * y - e * 6.0f * x * z + f * (4.0f * z2 - 3.0f * x2 - y2) +
          h * 2.0f * x * z + k * 3.0f * (x2 - y2);
    g.y = g.y + a * 3.0f * (x2 - y2) + b * x * z + c * (4.0f * z2 - x2 - 3.0f * y2) - e * 6.0f * y * z -
          f * 2.0f * x * y - h * 2.0f * y * z - k * 6.0f * x * y;
    g.z =
        g.z + b * x * y + c * 8.0f * y * z + e * (6.0f * z2 - 3.0f * x2 - 3.0f * y2) + f * 8.0f * x * z + h * (x2 - y2);
  }
  return g;
}

}  // namespace
