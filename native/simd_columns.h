// Rows in memory to vectors and back: W rows at a time, one per lane.
#pragma once

#include "simd.h"

namespace {

MIEN_INLINE F4 load4(const float* from) {
  F4 value;
  memcpy(&value, from, sizeof value);
  return value;
}
MIEN_INLINE void store4(float* to, F4 value) { memcpy(to, &value, sizeof value); }

// Rows to columns and back: v[j][i] and v[i][j] change places.
MIEN_INLINE void transpose4(F4* v) {
  const F4 a = __builtin_shufflevector(v[0], v[1], 0, 4, 1, 5), b = __builtin_shufflevector(v[0], v[1], 2, 6, 3, 7);
  const F4 c = __builtin_shufflevector(v[2], v[3], 0, 4, 1, 5), d = __builtin_shufflevector(v[2], v[3], 2, 6, 3, 7);
  v[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5);
  v[1] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
  v[2] = __builtin_shufflevector(b, d, 0, 1, 4, 5);
  v[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
}

// x0 y0 z0 x1 | y1 z1 x2 y2 | z2 x3 y3 z3 to x, y, z.
MIEN_INLINE void split3(const float* from, F4* xyz) {
  const F4 a = load4(from), b = load4(from + 4), c = load4(from + 8);
  const F4 ab = __builtin_shufflevector(a, b, 2, 3, 4, 5), bc = __builtin_shufflevector(b, c, 2, 3, 4, 5);
  xyz[0] = __builtin_shufflevector(__builtin_shufflevector(a, a, 0, 3, 0, 3), bc, 0, 1, 4, 7);
  xyz[1] = __builtin_shufflevector(__builtin_shufflevector(a, ab, 1, 6, 1, 6),
                                   __builtin_shufflevector(b, c, 3, 6, 3, 6), 0, 1, 4, 5);
  xyz[2] = __builtin_shufflevector(__builtin_shufflevector(ab, b, 0, 5, 0, 5),
                                   __builtin_shufflevector(c, c, 0, 3, 0, 3), 0, 1, 4, 5);
}
// The inverse of split3.
MIEN_INLINE void join3(float* to, F4 x, F4 y, F4 z) {
  const F4 xy_low = __builtin_shufflevector(x, y, 0, 4, 1, 5), xy_high = __builtin_shufflevector(x, y, 2, 6, 3, 7);
  store4(to, __builtin_shufflevector(xy_low, __builtin_shufflevector(z, x, 0, 5, 0, 5), 0, 1, 4, 5));
  store4(to + 4, __builtin_shufflevector(__builtin_shufflevector(y, z, 1, 5, 1, 5), xy_high, 0, 1, 4, 5));
  store4(to + 8, __builtin_shufflevector(__builtin_shufflevector(z, x, 2, 7, 2, 7),
                                         __builtin_shufflevector(y, z, 3, 7, 3, 7), 0, 1, 4, 5));
}

// W lanes from parts of four. (Through memory this would stall: a wide load cannot take from several narrow stores.)
MIEN_INLINE F concatenate(const F4* parts) {
#if defined(__AVX512F__)
  return _mm512_insertf32x8(_mm512_castps256_ps512(_mm256_set_m128(parts[1], parts[0])),
                            _mm256_set_m128(parts[3], parts[2]), 1);
#elif defined(__AVX2__)
  return _mm256_set_m128(parts[1], parts[0]);
#else
  return parts[0];
#endif
}

// out[j][lane] = rows[lane][j] for W rows anywhere in memory; at least four columns.
template <int COUNT>
MIEN_INLINE void gather_columns(const float* const* rows, F* out) {
  static_assert(COUNT >= 4);
  for (int j = 0; j < COUNT; j += 4) {
    const int first = j + 4 <= COUNT ? j : COUNT - 4;  // the last four overlap those before
    F4 parts[4][W / 4];
    for (int part = 0; part < W / 4; ++part) {
      F4 v[4];
      for (int k = 0; k < 4; ++k) v[k] = load4(rows[4 * part + k] + first);
      transpose4(v);
      for (int k = 0; k < 4; ++k) parts[k][part] = v[k];
    }
    for (int k = 0; k < 4; ++k) out[first + k] = concatenate(parts[k]);
  }
}

// out[j][lane] = rows[lane * stride + j] for W rows; rows from `valid` on repeat the last one.
template <int COUNT>
MIEN_INLINE void load_columns(const float* rows, int64_t stride, int valid, F* out) {
  alignas(64) float buffer[COUNT][W];
  if (COUNT >= 4) {
    const float* starts[W];
    for (int lane = 0; lane < W; ++lane) starts[lane] = rows + (lane < valid ? lane : valid - 1) * stride;
    gather_columns<(COUNT >= 4 ? COUNT : 4)>(starts, out);
    return;
  }
  if (COUNT == 3 && stride == 3 && valid == W) {
    F4 parts[3][W / 4];
    for (int part = 0; part < W / 4; ++part) {
      F4 v[3];
      split3(rows + 12 * part, v);
      for (int j = 0; j < 3; ++j) parts[j][part] = v[j];
    }
    for (int j = 0; j < COUNT; ++j) out[j] = concatenate(parts[j]);
    return;
  }
  for (int lane = 0; lane < W; ++lane)
    for (int j = 0; j < COUNT; ++j) buffer[j][lane] = rows[(lane < valid ? lane : valid - 1) * stride + j];
  for (int j = 0; j < COUNT; ++j) out[j] = load(buffer[j]);
}

// rows[lane * stride + j] = columns[j][lane] for the first `valid` rows.
template <int COUNT>
MIEN_INLINE void store_columns(float* rows, int64_t stride, int valid, const F* columns) {
  alignas(64) float buffer[COUNT][W];
  for (int j = 0; j < COUNT; ++j) store(buffer[j], columns[j]);
  if (valid == W && COUNT >= 4) {
    for (int lane = 0; lane < W; lane += 4) {
      for (int j = 0; j < COUNT; j += 4) {
        const int first = j + 4 <= COUNT ? j : COUNT - 4;
        F4 v[4];
        for (int k = 0; k < 4; ++k) v[k] = load4(&buffer[first + k < COUNT ? first + k : 0][lane]);
        transpose4(v);
        for (int k = 0; k < 4; ++k) store4(rows + (lane + k) * stride + first, v[k]);
      }
    }
  } else if (valid == W && COUNT == 3 && stride == 3) {
    for (int lane = 0; lane < W; lane += 4)
      join3(rows + 3 * lane, load4(&buffer[0][lane]), load4(&buffer[1 % COUNT][lane]), load4(&buffer[2 % COUNT][lane]));
  } else {
    for (int lane = 0; lane < valid; ++lane)
      for (int j = 0; j < COUNT; ++j) rows[lane * stride + j] = buffer[j][lane];
  }
}

}  // namespace
