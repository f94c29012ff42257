// The basis of the light on a mesh, which alignment and the differentiable renderer share.
#pragma once

namespace mien {

// The nine real spherical harmonics of mien.render.mesh.sh_basis at a direction.
inline void sh_basis(const float* n, float out[9]) {
  const float x = n[0], y = n[1], z = n[2];
  out[0] = 0.28209479177387814f;
  out[1] = 0.4886025119029199f * y;
  out[2] = 0.4886025119029199f * z;
  out[3] = 0.4886025119029199f * x;
  out[4] = 1.0925484305920792f * x * y;
  out[5] = 1.0925484305920792f * y * z;
  out[6] = 0.31539156525252005f * (3 * z * z - 1);
  out[7] = 1.0925484305920792f * x * z;
  out[8] = 0.5462742152960396f * (x * x - y * y);
}

}  // namespace mien
