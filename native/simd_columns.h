// Rows in memory to vectors and back: W rows at a time, one per lane.
#pragma once

#include "simd.h"

namespace {

MIEN_INLINE F4 load4(const float* from) {
  F4 value;
  memcpy(&value, from, sizeof value);
  return value;
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

// W / 4 rows of four numbers, `stride` apart, and back.
MIEN_INLINE F load_fours(const float* from, int64_t stride) {
  F4 parts[W / 4];
  for (int part = 0; part < W / 4; ++part) parts[part] = load4(from + part * stride);
  return concatenate(parts);
}
MIEN_INLINE void store_fours(float* to, [[maybe_unused]] int64_t stride, F value) {
#if defined(__AVX512F__)
  _mm_storeu_ps(to, _mm512_castps512_ps128(value));
  _mm_storeu_ps(to + stride, _mm512_extractf32x4_ps(value, 1));
  _mm_storeu_ps(to + 2 * stride, _mm512_extractf32x4_ps(value, 2));
  _mm_storeu_ps(to + 3 * stride, _mm512_extractf32x4_ps(value, 3));
#elif defined(__AVX2__)
  _mm_storeu_ps(to, _mm256_castps256_ps128(value));
  _mm_storeu_ps(to + stride, _mm256_extractf128_ps(value, 1));
#else
  store(to, value);
#endif
}

// In every four lanes: two of a's, then two of b's.
template <int A0, int A1, int B0, int B1>
MIEN_INLINE F shuffle_fours(F a, F b) {
#if defined(__AVX512F__)
  return _mm512_shuffle_ps(a, b, A0 | A1 << 2 | B0 << 4 | B1 << 6);
#elif defined(__AVX2__)
  return _mm256_shuffle_ps(a, b, A0 | A1 << 2 | B0 << 4 | B1 << 6);
#else
  return __builtin_shufflevector(a, b, A0, A1, 4 + B0, 4 + B1);
#endif
}

// Four rows of four to columns and back, W / 4 times: in every four lanes, v[j][i] and v[i][j] change places.
MIEN_INLINE void transpose_fours(F* v) {
  const F a = shuffle_fours<0, 1, 0, 1>(v[0], v[1]), b = shuffle_fours<2, 3, 2, 3>(v[0], v[1]);
  const F c = shuffle_fours<0, 1, 0, 1>(v[2], v[3]), d = shuffle_fours<2, 3, 2, 3>(v[2], v[3]);
  v[0] = shuffle_fours<0, 2, 0, 2>(a, c);
  v[1] = shuffle_fours<1, 3, 1, 3>(a, c);
  v[2] = shuffle_fours<0, 2, 0, 2>(b, d);
  v[3] = shuffle_fours<1, 3, 1, 3>(b, d);
}

// Four points in a row, W / 4 times, `stride` apart: x0 y0 z0 x1 | y1 z1 x2 y2 | z2 x3 y3 z3 to x, y, z.
MIEN_INLINE void split3(const float* from, int64_t stride, F* xyz) {
  const F a = load_fours(from, stride), b = load_fours(from + 4, stride), c = load_fours(from + 8, stride);
  xyz[0] = shuffle_fours<0, 3, 0, 2>(a, shuffle_fours<2, 2, 1, 1>(b, c));
  xyz[1] = shuffle_fours<0, 2, 0, 2>(shuffle_fours<1, 1, 0, 0>(a, b), shuffle_fours<3, 3, 2, 2>(b, c));
  xyz[2] = shuffle_fours<0, 2, 0, 3>(shuffle_fours<2, 2, 1, 1>(a, b), c);
}
// The inverse of split3.
MIEN_INLINE void join3(float* to, int64_t stride, F x, F y, F z) {
  store_fours(to, stride, shuffle_fours<0, 2, 0, 2>(shuffle_fours<0, 0, 0, 0>(x, y), shuffle_fours<0, 0, 1, 1>(z, x)));
  store_fours(to + 4, stride,
              shuffle_fours<0, 2, 0, 2>(shuffle_fours<1, 1, 1, 1>(y, z), shuffle_fours<2, 2, 2, 2>(x, y)));
  store_fours(to + 8, stride,
              shuffle_fours<0, 2, 0, 2>(shuffle_fours<2, 2, 3, 3>(z, x), shuffle_fours<3, 3, 3, 3>(y, z)));
}

// out[j][lane] = rows[lane][j] for W rows anywhere in memory; at least four columns.
template <int COUNT>
MIEN_INLINE void gather_columns(const float* const* rows, F* out) {
  static_assert(COUNT >= 4);
  for (int j = 0; j < COUNT; j += 4) {
    const int first = j + 4 <= COUNT ? j : COUNT - 4;  // the last four overlap those before
    F v[4];
    for (int k = 0; k < 4; ++k) {
      F4 parts[W / 4];
      for (int part = 0; part < W / 4; ++part) parts[part] = load4(rows[4 * part + k] + first);
      v[k] = concatenate(parts);
    }
    transpose_fours(v);
    for (int k = 0; k < 4; ++k) out[first + k] = v[k];
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
    split3(rows, 12, out);
    return;
  }
  for (int lane = 0; lane < W; ++lane)
    for (int j = 0; j < COUNT; ++j) buffer[j][lane] = rows[(lane < valid ? lane : valid - 1) * stride + j];
  for (int j = 0; j < COUNT; ++j) out[j] = load(buffer[j]);
}

// rows[lane * stride + j] = columns[j][lane] for the first `valid` rows.
template <int COUNT>
MIEN_INLINE void store_columns(float* rows, int64_t stride, int valid, const F* columns) {
  if (valid == W && COUNT == 3 && stride == 3) {
    join3(rows, 12, columns[0], columns[1 % COUNT], columns[2 % COUNT]);
    return;
  }
  if (valid == W && COUNT >= 4) {
    for (int j = 0; j < COUNT; j += 4) {
      const int first = j + 4 <= COUNT ? j : COUNT - 4;
      F v[4];
      for (int k = 0; k < 4; ++k) v[k] = columns[COUNT >= 4 ? first + k : 0];
      transpose_fours(v);
      for (int k = 0; k < 4; ++k) store_fours(rows + k * stride + first, 4 * stride, v[k]);
    }
    return;
  }
  alignas(64) float buffer[COUNT][W];
  for (int j = 0; j < COUNT; ++j) store(buffer[j], columns[j]);
  for (int lane = 0; lane < valid; ++lane)
    for (int j = 0; j < COUNT; ++j) rows[lane * stride + j] = buffer[j][lane];
}

}  // namespace
