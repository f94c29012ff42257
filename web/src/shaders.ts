// The kernel of the native renderer (native/rasterize_geometry.h, rasterize_project.h, rasterize_blend.h): the same
// projection, dilation, cutoff and largest alpha.

import { SLOPE } from "./features";

/** Width of the textures that hold arrays. Every WebGL2 device has at least 2048. */
export const TEXTURE_WIDTH = 1024;

export const SPLAT_VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D u_frames, u_means, u_quats, u_scales, u_colors, u_sh;
uniform vec4 u_view[3];    // rows of head to camera
uniform mat3 u_shFrame;    // head to the frame of the view directions
uniform vec2 u_focal, u_centre, u_size;
uniform int u_shRest;      // coefficients per channel after the first
in uint a_index;
flat out vec4 v_place;     // centre, slope, log2 of the opacity
flat out vec2 v_roots;     // of sharpness and falloff
flat out vec3 v_color;
const float NEAR = 0.01, DILATION = 0.3, FOV_MARGIN = 0.3, LOG2_ALPHA_MIN = -7.994353437, HALF_LOG2E = 0.72134752044;

vec4 at(sampler2D array, int i) { return texelFetch(array, ivec2(i & ${TEXTURE_WIDTH - 1}, i >> ${Math.log2(TEXTURE_WIDTH)}), 0); }

mat3 turn(vec4 q) {
  q = normalize(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1. - 2. * (y * y + z * z), 2. * (x * y + w * z), 2. * (x * z - w * y),
              2. * (x * y - w * z), 1. - 2. * (x * x + z * z), 2. * (y * z + w * x),
              2. * (x * z + w * y), 2. * (y * z - w * x), 1. - 2. * (x * x + y * y));
}

vec3 shRest(int i, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  int s = i * u_shRest;
  vec3 c = -0.4886025119029199 * y * at(u_sh, s).rgb + 0.4886025119029199 * z * at(u_sh, s + 1).rgb
    - 0.4886025119029199 * x * at(u_sh, s + 2).rgb;
  if (u_shRest > 3)
    c += 1.0925484305920792 * x * y * at(u_sh, s + 3).rgb - 1.0925484305920792 * y * z * at(u_sh, s + 4).rgb
      + 0.31539156525252005 * (2. * zz - xx - yy) * at(u_sh, s + 5).rgb - 1.0925484305920792 * x * z * at(u_sh, s + 6).rgb
      + 0.5462742152960396 * (xx - yy) * at(u_sh, s + 7).rgb;
  if (u_shRest > 8)
    c += -0.5900435899266435 * y * (3. * xx - yy) * at(u_sh, s + 8).rgb + 2.890611442640554 * x * y * z * at(u_sh, s + 9).rgb
      - 0.4570457994644658 * y * (4. * zz - xx - yy) * at(u_sh, s + 10).rgb
      + 0.3731763325901154 * z * (2. * zz - 3. * xx - 3. * yy) * at(u_sh, s + 11).rgb
      - 0.4570457994644658 * x * (4. * zz - xx - yy) * at(u_sh, s + 12).rgb
      + 1.445305721320277 * z * (xx - yy) * at(u_sh, s + 13).rgb - 0.5900435899266435 * x * (xx - 3. * yy) * at(u_sh, s + 14).rgb;
  return c;
}

void main() {
  gl_Position = vec4(2, 2, 2, 1);  // outside of the picture
  int i = int(a_index);
  vec4 mean = at(u_means, i), color = at(u_colors, i), a, b, c;
  int f = 3 * int(mean.w);
  a = at(u_frames, f); b = at(u_frames, f + 1); c = at(u_frames, f + 2);
  vec4 local = vec4(mean.xyz, 1);
  vec4 head = vec4(dot(a, local), dot(b, local), dot(c, local), 1);
  vec3 p = vec3(dot(u_view[0], head), dot(u_view[1], head), dot(u_view[2], head));
  float log2Opacity = log2(max(color.a, 1e-30));
  if (p.z <= NEAR || log2Opacity < LOG2_ALPHA_MIN) return;
  vec2 tangent = p.xy / p.z, margin = FOV_MARGIN * .5 * u_size / u_focal;
  vec2 centre = u_focal * tangent + u_centre;
  vec2 clamped = clamp(tangent, -u_centre / u_focal - margin, (u_size - u_centre) / u_focal + margin);
  vec2 j = u_focal / p.z;
  vec3 n0 = j.x * (u_view[0].xyz - clamped.x * u_view[2].xyz), n1 = j.y * (u_view[1].xyz - clamped.y * u_view[2].xyz);
  mat3 frame = transpose(mat3(a.xyz, b.xyz, c.xyz)) * turn(at(u_quats, i));
  vec3 scale = at(u_scales, i).xyz, u0 = (n0 * frame) * scale, u1 = (n1 * frame) * scale, area = cross(u0, u1);
  float xx = dot(u0, u0), yy = dot(u1, u1), xy = dot(u0, u1);
  float determinant = dot(area, area) + DILATION * (xx + yy) + DILATION * DILATION;
  xx += DILATION; yy += DILATION;
  if (!(xx < 1e30 && yy < 1e30 && determinant < 1e30)) return;
  float slope = xy / yy;
  v_place = vec4(centre, slope, log2Opacity);
  v_roots = vec2(sqrt(yy / determinant * HALF_LOG2E), sqrt(HALF_LOG2E / yy));
  vec3 rgb = 0.5 + 0.28209479177387814 * color.rgb;
  if (u_shRest > 0) {
    vec3 t = vec3(u_view[0].w, u_view[1].w, u_view[2].w);
    vec3 eye = -(t.x * u_view[0].xyz + t.y * u_view[1].xyz + t.z * u_view[2].xyz);
    rgb += shRest(i, u_shFrame * normalize(head.xyz - eye));
  }
  v_color = max(rgb, 0.);
  // A parallelogram around the ellipse where alpha is 1/255, a little larger for what is rounded.
  float reach = sqrt(max((log2Opacity - LOG2_ALPHA_MIN) * 1.3862943611, 0.)) + .1;
  vec2 corner = reach * vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2. - reach;
  float dy = sqrt(yy) * corner.y;
  vec2 pixel = centre + vec2(slope * dy + sqrt(determinant / yy) * corner.x, dy);
  gl_Position = vec4(2. * pixel.x / u_size.x - 1., 1. - 2. * pixel.y / u_size.y, 0, 1);
}`;

export const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
uniform vec2 u_size;
flat in vec4 v_place; flat in vec2 v_roots; flat in vec3 v_color;
out vec4 o_color;
void main() {
  vec2 d = vec2(gl_FragCoord.x, u_size.y - gl_FragCoord.y) - v_place.xy;
  vec2 r = v_roots * vec2(d.x - v_place.z * d.y, d.y);
  float power = v_place.w - dot(r, r);
  if (power < -7.994353437) discard;
  float alpha = min(exp2(power), 0.999);
  o_color = vec4(v_color * alpha, alpha);
}`;

export const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0, 1); }`;

export const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D u_picture;
uniform vec4 u_background;  // premultiplied
out vec4 o_color;
void main() {
  vec4 c = texelFetch(u_picture, ivec2(gl_FragCoord.xy), 0);
  c += (1. - c.a) * u_background;
  o_color = vec4(clamp(c.rgb, 0., c.a), c.a);
}`;

/** Width of the textures that hold the arrays of features. Every WebGL2 device has at least 2048. */
export const FEATURE_WIDTH = 2048;

/** The network of features.ts at one pixel for each Gaussian: with `texels` of features, `rank` activations, `hidden` units, `fours` of regions. */
export function featureFragment(texels: number, rank: number, hidden: number, fours: number): string {
  return `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D u_rest, u_neutral, u_basis, u_own, u_weights, u_shares;
uniform vec4 u_activations[${rank * fours}];
uniform vec4 u_bias;
uniform int u_count;
out vec4 o_color;
vec4 at(sampler2D array, int i) { return texelFetch(array, ivec2(i & ${FEATURE_WIDTH - 1}, i >> ${Math.log2(FEATURE_WIDTH)}), 0); }
void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  int i = place.y * ${TEXTURE_WIDTH} + place.x;
  if (i >= u_count) discard;
  vec4 f[${texels}];
  for (int t = 0; t < ${texels}; ++t) f[t] = at(u_neutral, i * ${texels} + t);
  vec4 shares[${fours}];
  for (int s = 0; s < ${fours}; ++s) shares[s] = at(u_shares, i * ${fours} + s);
  for (int k = 0; k < ${rank}; ++k) {
    float a = 0.;
    for (int s = 0; s < ${fours}; ++s) a += dot(shares[s], u_activations[k * ${fours} + s]);
    if (a != 0.) for (int t = 0; t < ${texels}; ++t) f[t] += a * at(u_basis, (i * ${rank} + k) * ${texels} + t);
  }
  vec4 sum = u_bias;
  for (int q = 0; q < ${hidden / 4}; ++q) {
    vec4 own = at(u_own, i * ${hidden / 4} + q);
    for (int c = 0; c < 4; ++c) {
      int w = (4 * q + c) * ${texels + 1};
      float x = own[c];
      for (int t = 0; t < ${texels}; ++t) x += dot(at(u_weights, w + t), f[t]);
      sum += at(u_weights, w + ${texels}) * (x < 0. ? ${SLOPE} * x : x);
    }
  }
  sum += texelFetch(u_rest, place, 0);
  o_color = vec4(sum.rgb, 1. / (1. + exp(-sum.a)));
}`;
}
