// Forward projection, and which tiles a splat touches.
#pragma once

#include "rasterize_geometry.h"

namespace {

MIEN_INLINE M not_finite(const F* values, int count) {
  F total{};
  for (int j = 0; j < count; ++j) total = total + (values[j] - values[j]);  // 0, or NaN for NaN and infinity
  return but_not(less_equal(F{}, set1(0.0f)), less_equal(total, set1(0.0f)));
}

// Colours of W Gaussians; sets `bad` where a coefficient is not finite.
template <int COUNT>
MIEN_INLINE V3 colors_of(const float* sh, int valid, V3 direction, M* bad) {
  F coefficients[3 * COUNT], basis[COUNT];
  load_columns<3 * COUNT>(sh, 3 * COUNT, valid, coefficients);
  sh_basis<COUNT>(direction, basis);
  F c[3] = {set1(0.5f), set1(0.5f), set1(0.5f)};
  for (int j = 0; j < COUNT; ++j)
    for (int channel = 0; channel < 3; ++channel) c[channel] = c[channel] + basis[j] * coefficients[3 * j + channel];
  *bad = not_finite(c, 3);
  return {maximum(c[0], F{}), maximum(c[1], F{}), maximum(c[2], F{})};
}

MIEN_INLINE V3 colors_of(int count, const float* sh, int valid, V3 direction, M* bad) {
  if (count == 1) return colors_of<1>(sh, valid, direction, bad);
  if (count == 4) return colors_of<4>(sh, valid, direction, bad);
  if (count == 9) return colors_of<9>(sh, valid, direction, bad);
  return colors_of<16>(sh, valid, direction, bad);
}

struct Outline {
  F cutoff2;  // the squared Mahalanobis distance where alpha is 1/255
  F half_width, half_height;
  M drawn;
};

MIEN_INLINE Outline outline_of(const Projection& p, const View& view, F log2_opacity) {
  Outline o;
  o.cutoff2 = maximum((log2_opacity - kLog2AlphaMin) * 1.3862943611f, F{});  // 2 ln 2
  o.half_width = square_root(o.cutoff2 * p.xx);
  o.half_height = square_root(o.cutoff2 * p.yy);
  const M across = both(less(F{}, p.x + o.half_width), less(p.x - o.half_width, set1((float)view.width)));
  const M along = both(less(F{}, p.y + o.half_height), less(p.y - o.half_height, set1((float)view.height)));
  const F huge = set1(1e30f);  // a covariance that overflows cannot be drawn
  const M sane = both(less(p.xx, huge), both(less(p.yy, huge), less(p.determinant, huge)));
  o.drawn = both(both(p.in_front, sane), both(across, along));
  o.drawn = both(o.drawn, less_equal(set1(kLog2AlphaMin), log2_opacity));
  return o;
}

MIEN_INLINE void store_radii(const Projection& p, M drawn, int valid, int32_t* radii) {
  const F middle = 0.5f * (p.xx + p.yy), half = 0.5f * (p.xx - p.yy);
  const F radius = 3.0f * square_root(middle + square_root(half * half + p.xy * p.xy));
  const F rounded = -round_down(-minimum(radius, set1(1e9f)));
  alignas(64) int32_t lanes[W];
  store(lanes, truncate(keep(drawn, rounded)));
  for (int lane = 0; lane < valid; ++lane) radii[lane] = lanes[lane];
}

struct SplatShape {
  F x, y, slope, width2, half_height, y_rightmost, inverse_half_height;
};

MIEN_INLINE SplatShape gather_shapes(const Splat* const* splats) {
  const float* rows[W];
  for (int lane = 0; lane < W; ++lane) rows[lane] = &splats[lane]->x;
  F v[8];
  gather_columns<8>(rows, v);
  return {v[0], v[1], v[2], v[3], v[4], v[5], v[7]};
}

// Where splats' ellipses cross strips of pixel rows, in groups of `size` pixels, `count` of them from the one whose
// first pixel centre is `first` right of the splat's. Exact, because within a strip the ellipse is widest at its
// rightmost point or, if that lies outside, at the edge nearer to it; then half a thousandth wider, for what is
// rounded.
struct Strips {
  F slope, width2, width2_fall, half_height, y_rightmost;  // x in groups, y in pixels
  F to_end, to_rest;

  MIEN_INLINE Strips(const SplatShape& s, F first, float size, F count)
      : half_height(s.half_height), y_rightmost(s.y_rightmost) {
    const float per_group = 1.0f / size;
    slope = s.slope * per_group;
    width2 = s.width2 * (1.001f * per_group * per_group);
    width2_fall = width2 * s.inverse_half_height * s.inverse_half_height;
    to_end = 1.0f - first * per_group;
    to_rest = count + (first + (size - 1.0f)) * per_group;
  }
  MIEN_INLINE F half_width(F y) const { return root_estimate(maximum(width2 - width2_fall * y * y, set1(1e-30f))); }
  // The strip of pixel centres top..bottom, relative to the splat's. To be clamped to 0..count and truncated: how many
  // groups there are up to the last that is touched, and from the first that is touched.
  MIEN_INLINE void touch(F top, F bottom, F* end, F* rest) const {
    const F right_y = clamp(y_rightmost, top, bottom), left_y = clamp(-y_rightmost, top, bottom);
    const M hit = both(less_equal(top, half_height), less_equal(-half_height, bottom));
    *end = keep(hit, (slope * right_y + half_width(right_y)) + to_end);
    *rest = to_rest - (slope * left_y - half_width(left_y));
  }
};

// The tiles of W splats, for those that have any. Returns how many there are in the first two rows.
MIEN_INLINE I store_spans(const SplatShape& s, TileGrid grid, int valid, TileSpan* spans) {
  const F last_row = set1((float)(grid.rows - 1)), columns = set1((float)grid.columns);
  const F first_row = clamp(round_down((s.y - s.half_height - 0.5f) * (1.0f / kTile)), F{}, last_row);
  const F end_row = clamp(round_down((s.y + s.half_height - 0.5f) * (1.0f / kTile)), F{}, last_row);
  I low[2], high[2];
  const Strips strips(s, 0.5f - s.x, kTile, columns);
  for (int row = 0; row < 2; ++row) {
    const F top = (first_row + (float)row) * (float)kTile + 0.5f - s.y;
    F end, rest;
    strips.touch(top, top + (kTile - 1.0f), &end, &rest);
    end = keep(less_equal(first_row + (float)row, end_row), end);
    low[row] = set1i(grid.columns) - truncate(clamp(rest, F{}, columns));
    high[row] = truncate(clamp(end, F{}, columns)) - 1;
  }
  const I first = truncate(first_row), count = truncate(end_row) - first + 1;
  // Two halves a word, as TileSpan has them.
  const F words[3] = {from_bits(first | count << 16), from_bits(low[0] | low[1] << 16),
                      from_bits((high[0] & 0xffff) | high[1] << 16)};
  static_assert(sizeof(TileSpan) == sizeof(float[3]) && __builtin_offsetof(TileSpan, high) == 8);
  float rows[3 * W];
  store_columns<3>(rows, 3, W, words);
  memcpy(spans, rows, sizeof(TileSpan) * valid);
  const I above = high[0] - low[0] + 1, below = high[1] - low[1] + 1;
  return (above & ~(above >> 31)) + (below & ~(below >> 31));  // never negative
}

// What is known of the drawn Gaussians in each lane so far.
struct Depths {
  F nearest = set1(3e38f), farthest{};
  int64_t drawn = 0;

  MIEN_INLINE void add(F depth, M is_drawn) {
    nearest = minimum(nearest, select(is_drawn, depth, nearest));
    farthest = maximum(farthest, keep(is_drawn, depth));
    drawn += __builtin_popcount(lane_bits(is_drawn));
  }
  MIEN_INLINE DepthRange range() const {
    float least = nearest[0], greatest = farthest[0];
    for (int lane = 1; lane < W; ++lane) {
      least = nearest[lane] < least ? nearest[lane] : least;
      greatest = farthest[lane] > greatest ? farthest[lane] : greatest;
    }
    DepthRange result{drawn, 0, 0};
    memcpy(&result.nearest, &least, sizeof least);  // positive floats sort as their bits
    memcpy(&result.farthest, &greatest, sizeof greatest);
    return result;
  }
};

// Returns the lanes with a NaN or an infinity.
MIEN_INLINE M project_group(const GaussianArrays& g, const View& view, int64_t i, int valid, const Projected& out,
                            Depths& depths) {
  F in[11];
  load_columns<3>(g.means + 3 * i, 3, valid, in);
  load_columns<4>(g.quats + 4 * i, 4, valid, in + 3);
  load_columns<3>(g.scales + 3 * i, 3, valid, in + 7);
  load_columns<1>(g.opacities + i, 1, valid, in + 10);
  M bad = not_finite(in, 11);
  const Projection p = project_lanes(view, in, in + 3, in + 7);
  const F log2_opacity = log2_precise(maximum(in[10], set1(1e-30f)));
  const Outline o = outline_of(p, view, log2_opacity);
  F inverse_distance;
  V3 color{F{}, F{}, F{}};
  if (any(o.drawn)) {
    M bad_color;
    color = colors_of(g.sh_count, g.sh + 3 * g.sh_count * i, valid, view_direction(view, in, &inverse_distance),
                      &bad_color);
    bad = either(bad, both(bad_color, o.drawn));
  }
  const F inverse = 1.0f / p.determinant, inverse_yy = 1.0f / p.yy;
  const F columns[16] = {p.x,
                         p.y,
                         p.xy * inverse_yy,
                         o.cutoff2 * p.determinant * inverse_yy,
                         o.half_height,
                         p.xy * square_root(o.cutoff2 / p.xx),
                         p.camera.z,
                         1.0f / maximum(o.half_height, set1(1e-30f)),
                         square_root(p.yy * inverse * kHalfLog2E),
                         square_root(inverse_yy * kHalfLog2E),
                         log2_opacity,
                         color.x,
                         color.y,
                         color.z,
                         F{},
                         F{}};
  store_columns<16>(&out.splats[i].x, 16, valid, columns);
  store_radii(p, o.drawn, valid, out.radii + i);
  I tiles{};
  if (any(o.drawn)) {
    const SplatShape shape{columns[0], columns[1], columns[2], columns[3], columns[4], columns[5], columns[7]};
    tiles = bits(keep(o.drawn, from_bits(store_spans(shape, out.grid, valid, out.spans + i))));
  }
  alignas(64) int32_t counts[W];
  store(counts, tiles);
  memcpy(out.slot_counts + i, counts, sizeof(uint32_t) * valid);
  depths.add(p.camera.z, both(o.drawn, less(iota(), set1((float)valid))));
  const uint32_t drawn = lane_bits(o.drawn);
  for (int lane = 0; lane < valid; ++lane) {
    uint32_t key;
    memcpy(&key, &out.splats[i + lane].depth, 4);  // positive floats sort as their bits
    out.depth_keys[i + lane] = drawn >> lane & 1 ? key : UINT32_MAX;
  }
  return bad;
}

bool project(const GaussianArrays& g, const View& view, int64_t first, int64_t last, const Projected& out) {
  M bad = no_lanes();
  Depths depths;
  for (int64_t i = first; i < last; i += W) {
    const int valid = last - i < W ? (int)(last - i) : W;
    bad = either(bad, project_group(g, view, i, valid, out, depths));
  }
  out.depth_ranges[first / kGroup] = depths.range();
  return !any(bad);
}

}  // namespace
