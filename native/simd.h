// The few vector operations that the kernels need, at the native width of the instruction set this file is compiled
// for: 16 floats with AVX-512, 8 with AVX2, 4 otherwise (SSE4.2, NEON, WebAssembly). `F`, `I` and `M` are a float, an
// int32 and a mask vector; + - * / & | << on them are the compiler's own, a * b + c becomes a fused multiply-add.
//
// Everything lives in an unnamed namespace: kernel files are compiled once per instruction set, and no function
// compiled for a newer one may be picked by the linker for an older one. For the same reason: no std templates here.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#define MIEN_INLINE inline __attribute__((always_inline))

namespace {

#if defined(__AVX512F__)
constexpr int W = 16;
#elif defined(__AVX2__)
constexpr int W = 8;
#else
constexpr int W = 4;
#endif

typedef float F __attribute__((vector_size(4 * W)));
typedef int32_t I __attribute__((vector_size(4 * W)));
typedef float F4 __attribute__((vector_size(16)));

MIEN_INLINE F set1(float value) { return value - F{}; }
MIEN_INLINE I set1i(int32_t value) { return value - I{}; }
MIEN_INLINE F load(const float* from) {
  F value;
  memcpy(&value, from, sizeof value);
  return value;
}
MIEN_INLINE void store(float* to, F value) { memcpy(to, &value, sizeof value); }
MIEN_INLINE void store(int32_t* to, I value) { memcpy(to, &value, sizeof value); }
MIEN_INLINE I bits(F value) { return (I)value; }
MIEN_INLINE F from_bits(I value) { return (F)value; }
MIEN_INLINE F to_float(I value) { return __builtin_convertvector(value, F); }
MIEN_INLINE I truncate(F value) { return __builtin_convertvector(value, I); }

// 0, 1, 2, ...
MIEN_INLINE F iota() {
  F value;
  for (int lane = 0; lane < W; ++lane) value[lane] = (float)lane;
  return value;
}

#if defined(__AVX512F__)

typedef __mmask16 M;
MIEN_INLINE M less(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
MIEN_INLINE M less_equal(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
MIEN_INLINE M both(M a, M b) { return (M)(a & b); }
MIEN_INLINE M either(M a, M b) { return (M)(a | b); }
MIEN_INLINE M but_not(M a, M b) { return (M)(a & ~b); }
MIEN_INLINE M no_lanes() { return 0; }
MIEN_INLINE F select(M mask, F yes, F no) { return _mm512_mask_blend_ps(mask, no, yes); }
MIEN_INLINE F keep(M mask, F value) { return _mm512_maskz_mov_ps(mask, value); }
MIEN_INLINE bool any(M mask) { return mask != 0; }
MIEN_INLINE uint32_t lane_bits(M mask) { return mask; }
MIEN_INLINE F minimum(F a, F b) { return _mm512_min_ps(a, b); }
MIEN_INLINE F maximum(F a, F b) { return _mm512_max_ps(a, b); }
MIEN_INLINE F square_root(F a) { return _mm512_sqrt_ps(a); }
MIEN_INLINE F reciprocal_estimate(F a) { return _mm512_rcp14_ps(a); }
MIEN_INLINE F root_estimate(F a) { return a * _mm512_rsqrt14_ps(a); }
MIEN_INLINE F round_down(F a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }

#else

typedef I M;
MIEN_INLINE M less(F a, F b) { return a < b; }
MIEN_INLINE M less_equal(F a, F b) { return a <= b; }
MIEN_INLINE M both(M a, M b) { return a & b; }
MIEN_INLINE M either(M a, M b) { return a | b; }
MIEN_INLINE M but_not(M a, M b) { return a & ~b; }
MIEN_INLINE M no_lanes() { return M{}; }
MIEN_INLINE F keep(M mask, F value) { return (F)(mask & (I)value); }

#if defined(__AVX2__)
MIEN_INLINE F select(M mask, F yes, F no) { return _mm256_blendv_ps(no, yes, (F)mask); }
MIEN_INLINE uint32_t lane_bits(M mask) { return (uint32_t)_mm256_movemask_ps((F)mask); }
MIEN_INLINE F minimum(F a, F b) { return _mm256_min_ps(a, b); }
MIEN_INLINE F maximum(F a, F b) { return _mm256_max_ps(a, b); }
MIEN_INLINE F square_root(F a) { return _mm256_sqrt_ps(a); }
MIEN_INLINE F reciprocal_estimate(F a) { return _mm256_rcp_ps(a); }
MIEN_INLINE F root_estimate(F a) { return a * _mm256_rsqrt_ps(a); }
MIEN_INLINE F round_down(F a) { return _mm256_floor_ps(a); }
#elif defined(__SSE4_1__)
MIEN_INLINE F select(M mask, F yes, F no) { return _mm_blendv_ps(no, yes, (F)mask); }
MIEN_INLINE uint32_t lane_bits(M mask) { return (uint32_t)_mm_movemask_ps((F)mask); }
MIEN_INLINE F minimum(F a, F b) { return _mm_min_ps(a, b); }
MIEN_INLINE F maximum(F a, F b) { return _mm_max_ps(a, b); }
MIEN_INLINE F square_root(F a) { return _mm_sqrt_ps(a); }
MIEN_INLINE F reciprocal_estimate(F a) { return _mm_rcp_ps(a); }
MIEN_INLINE F root_estimate(F a) { return a * _mm_rsqrt_ps(a); }
MIEN_INLINE F round_down(F a) { return _mm_floor_ps(a); }
#else
MIEN_INLINE F select(M mask, F yes, F no) { return (F)((mask & (I)yes) | (~mask & (I)no)); }
MIEN_INLINE uint32_t lane_bits(M mask) {
  uint32_t result = 0;
  for (int lane = 0; lane < W; ++lane) result |= (uint32_t)(mask[lane] & (1 << lane));
  return result;
}
MIEN_INLINE F minimum(F a, F b) { return select(a < b, a, b); }
MIEN_INLINE F maximum(F a, F b) { return select(a > b, a, b); }
MIEN_INLINE F square_root(F a) {
  for (int lane = 0; lane < W; ++lane) a[lane] = __builtin_sqrtf(a[lane]);
  return a;
}
MIEN_INLINE F reciprocal_estimate(F a) { return 1.0f / a; }
MIEN_INLINE F root_estimate(F a) { return square_root(a); }
MIEN_INLINE F round_down(F a) {
  const F truncated = to_float(truncate(a));
  return truncated - keep(a < truncated, set1(1.0f));
}
#endif
MIEN_INLINE bool any(M mask) { return lane_bits(mask) != 0; }

#endif

MIEN_INLINE F clamp(F value, F low, F high) { return minimum(maximum(value, low), high); }

// An upper bound of sqrt(a), at most 1e-3 too large; for a = 0 a tiny positive number.
MIEN_INLINE F root_bound(F a) { return root_estimate(maximum(a, set1(1e-30f))) * 1.0005f; }

// 1 / a to about 2e-7 (relative): the estimate and one Newton step.
MIEN_INLINE F reciprocal(F a) {
  const F estimate = reciprocal_estimate(a);
  return estimate * (2.0f - a * estimate);
}

// 2^a to 2e-7 (relative) for -100 < a < 100, anything beyond. Adding 1.5 * 2^23 leaves round(a) in the low bits of the
// sum; the polynomial is the minimax one for 2^f on -0.5..0.5, and the integer part goes straight into the exponent.
MIEN_INLINE F exp2_fast(F a) {
  const F shifted = a + 12582912.0f;
  const F f = a - (shifted - 12582912.0f);
  F power = set1(1.3276471979e-3f);
  power = power * f + 9.6755413342e-3f;
  power = power * f + 5.5507132735e-2f;
  power = power * f + 2.4022119724e-1f;
  power = power * f + 6.9314696706e-1f;
  power = power * f + 1.0000000717f;
  return from_bits(bits(power) + (bits(shifted) << 23));
}

// log2(a) to 1e-7 (absolute, near 1; relative elsewhere) for positive normal a: with a = m 2^e, m in 0.7..1.4 and
// t = (m - 1) / (m + 1), log2(m) = 2 / ln 2 * atanh(t).
MIEN_INLINE F log2_precise(F a) {
  const I offset = (bits(a) - 0x3f3504f3) >> 23;  // 0x3f3504f3 is sqrt(1 / 2)
  const F m = from_bits(bits(a) - (offset << 23));
  const F t = (m - 1.0f) / (m + 1.0f), t2 = t * t;
  F series = set1(1.0f / 9);
  series = series * t2 + 1.0f / 7;
  series = series * t2 + 1.0f / 5;
  series = series * t2 + 1.0f / 3;
  series = series * t2 + 1.0f;
  return to_float(offset) + 2.8853900818f * t * series;
}

MIEN_INLINE float sum(F value) {
  float total = 0;
  for (int lane = 0; lane < W; ++lane) total += value[lane];
  return total;
}

// The sum of all lanes of a vector, four lanes left.
MIEN_INLINE F4 fold(F value) {
#if defined(__AVX512F__)
  const __m256 half = _mm512_castps512_ps256(value) + _mm512_extractf32x8_ps(value, 1);
  return _mm256_castps256_ps128(half) + _mm256_extractf128_ps(half, 1);
#elif defined(__AVX2__)
  return _mm256_castps256_ps128(value) + _mm256_extractf128_ps(value, 1);
#else
  return value;
#endif
}

// The sums over all lanes of four vectors.
MIEN_INLINE F4 sums_of_four(F a, F b, F c, F d) {
  const F4 fa = fold(a), fb = fold(b), fc = fold(c), fd = fold(d);
  const F4 ab = __builtin_shufflevector(fa, fb, 0, 4, 1, 5) + __builtin_shufflevector(fa, fb, 2, 6, 3, 7);
  const F4 cd = __builtin_shufflevector(fc, fd, 0, 4, 1, 5) + __builtin_shufflevector(fc, fd, 2, 6, 3, 7);
  return __builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
}

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
