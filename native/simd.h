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

// The value itself, rounded: the compiler may not make one operation of the one that made it and one that follows.
MIEN_INLINE F rounded(F value) {
#if defined(__AVX512F__)
  __asm__("" : "+v"(value));
#elif defined(__x86_64__)
  __asm__("" : "+x"(value));
#elif defined(__aarch64__)
  __asm__("" : "+w"(value));
#endif
  return value;
}

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
// sqrt(a), a > 0, to 4e-4 (relative) or better.
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

// While one of these lives, results that would be denormal are 0: they would be slow on some processors.
struct NoDenormals {
#if defined(__x86_64__)
  const unsigned before = _mm_getcsr();
  NoDenormals() { _mm_setcsr(before | 0x8040); }
  ~NoDenormals() { _mm_setcsr(before); }
#endif
};

MIEN_INLINE F clamp(F value, F low, F high) { return minimum(maximum(value, low), high); }

// 1 / a to about 2e-7 (relative): the estimate and one Newton step.
MIEN_INLINE F reciprocal(F a) {
  const F estimate = reciprocal_estimate(a);
  return estimate * (2.0f - a * estimate);
}

// Without overflow: far outside their range exponentials may be anything, but are computed.
MIEN_INLINE I add_wrapping(I a, I b) {
  typedef uint32_t U __attribute__((vector_size(4 * W)));
  return (I)((U)a + (U)b);
}

// sum + a * b where `mask` is set, else sum.
MIEN_INLINE F add_where(M mask, F a, F b, F sum) {
#if defined(__AVX512F__)
  return _mm512_mask3_fmadd_ps(a, b, sum, mask);
#else
  return sum + keep(mask, a) * b;
#endif
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
  return from_bits(add_wrapping(bits(power), bits(shifted) << 23));
}

// 2^a for what is seen of a splat: -8 < a <= 0, anything beyond; to 6e-7 (relative) with AVX-512, 4e-6 with AVX2. A
// vector register holds the powers of 2 in steps of 1/16 (1/8), so that a parabola does for the rest: K ((f + c)^2 +
// e), with K already in the powers. Theirs is less the index where the exponent will be added.
#if defined(__AVX512F__) || defined(__AVX2__)
alignas(64) constexpr int32_t kPowers[W] = {
#if defined(__AVX512F__)
    0x3e75fc17, 0x3e78700d, 0x3e761fc7, 0x3e740ff3, 0x3e72436e, 0x3e70bd31, 0x3e6f8059, 0x3e6e9027,
    0x3e6deffe, 0x3e6da36a, 0x3e6dae1f, 0x3e6e13f9, 0x3e6ed901, 0x3e70016f, 0x3e7191a9, 0x3e738e48};
constexpr int kPowerBits = 4;
constexpr float kParabolaShift = 1.442822f, kParabolaRise = 2.0811248f;  // c, e; K = 0.24021946
#else
    0x3e75f68d, 0x3e761cc1, 0x3e724023, 0x3e6f7cc2, 0x3e6dec13, 0x3e6da9d9, 0x3e6ed459, 0x3e718c95};
constexpr int kPowerBits = 3;
constexpr float kParabolaShift = 1.4432027f, kParabolaRise = 2.0803926f;  // K = 0.24019833
#endif

MIEN_INLINE F exp2_alpha(F a) {
  const float magic = 12582912.0f / (1 << kPowerBits);  // the sum's low bits are round(a * 2^kPowerBits)
  const F shifted = a + magic, f = (a - (shifted - magic)) + kParabolaShift;
  I powers;
  memcpy(&powers, kPowers, sizeof powers);
#if defined(__AVX512F__)
  const I power = (I)_mm512_permutexvar_epi32((__m512i)bits(shifted), (__m512i)powers);
#else
  const I power = (I)_mm256_permutevar8x32_epi32((__m256i)powers, (__m256i)bits(shifted));
#endif
  return from_bits(add_wrapping(power, bits(shifted) << (23 - kPowerBits))) * (f * f + kParabolaRise);
}
#else
MIEN_INLINE F exp2_alpha(F a) { return exp2_fast(a); }
#endif

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

// The lowest byte of each lane, of values 0..255.
MIEN_INLINE void store_bytes(uint8_t* to, I value) {
#if defined(__AVX512F__)
  _mm_storeu_si128((__m128i*)to, _mm512_cvtepi32_epi8((__m512i)value));
#else
  for (int lane = 0; lane < W; ++lane) to[lane] = (uint8_t)value[lane];
#endif
}

// Bit `bit` of 64 bytes, one after the other.
MIEN_INLINE uint64_t bit_column(const uint8_t* bytes, int bit) {
#if defined(__AVX512BW__)
  return _mm512_test_epi8_mask(_mm512_loadu_si512(bytes), _mm512_set1_epi8((char)(1 << bit)));
#elif defined(__AVX2__)
  uint64_t column = 0;
  for (int half = 0; half < 2; ++half) {
    const __m256i own = _mm256_loadu_si256((const __m256i*)(bytes + 32 * half));
    const __m256i top = _mm256_sll_epi16(own, _mm_cvtsi32_si128(7 - bit));
    column |= (uint64_t)(uint32_t)_mm256_movemask_epi8(top) << (32 * half);
  }
  return column;
#else
  uint64_t column = 0;
  for (int part = 0; part < 8; ++part) {
    uint64_t eight;
    memcpy(&eight, bytes + 8 * part, sizeof eight);
    // The bits of eight bytes meet in the highest byte of the product (the first byte is the lowest).
    column |= ((eight >> bit & 0x0101010101010101u) * 0x0102040810204080u >> 56) << (8 * part);
  }
  return column;
#endif
}

typedef uint8_t Bytes16 __attribute__((vector_size(16)));

// Eight rows of 16 bytes to 16 numbers: byte `row` of number i is rows[row * stride + i].
MIEN_INLINE void transpose_bytes(const uint8_t* rows, int64_t stride, uint64_t* numbers) {
  Bytes16 v[8], w[8];
  for (int row = 0; row < 8; ++row) memcpy(&v[row], rows + row * stride, sizeof v[row]);
  for (int i = 0; i < 4; ++i) {
    w[i] = __builtin_shufflevector(v[2 * i], v[2 * i + 1], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    w[4 + i] =
        __builtin_shufflevector(v[2 * i], v[2 * i + 1], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
  }
  typedef uint16_t Pairs __attribute__((vector_size(16)));
  typedef uint32_t Quads __attribute__((vector_size(16)));
  for (int half = 0; half < 2; ++half) {
    const Pairs a = (Pairs)w[4 * half], b = (Pairs)w[4 * half + 1], c = (Pairs)w[4 * half + 2];
    const Pairs d = (Pairs)w[4 * half + 3];
    const Quads ab = (Quads)__builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
    const Quads cd = (Quads)__builtin_shufflevector(c, d, 0, 8, 1, 9, 2, 10, 3, 11);
    const Quads ef = (Quads)__builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
    const Quads gh = (Quads)__builtin_shufflevector(c, d, 4, 12, 5, 13, 6, 14, 7, 15);
    const Quads out[4] = {__builtin_shufflevector(ab, cd, 0, 4, 1, 5), __builtin_shufflevector(ab, cd, 2, 6, 3, 7),
                          __builtin_shufflevector(ef, gh, 0, 4, 1, 5), __builtin_shufflevector(ef, gh, 2, 6, 3, 7)};
    memcpy(numbers + 8 * half, out, sizeof out);
  }
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

MIEN_INLINE float sum(F value) {
  const F4 four = fold(value), two = four + __builtin_shufflevector(four, four, 2, 3, 2, 3);
  return two[0] + two[1];
}

// The sums over all lanes of eight vectors.
MIEN_INLINE void sums_of_eight(const F* v, F4* sums) {
#if defined(__AVX512F__)
  // Within each quarter of a vector; then over the quarters.
  for (int half = 0; half < 2; ++half, v += 4) {
    const F ab = _mm512_unpacklo_ps(v[0], v[1]) + (F)_mm512_unpackhi_ps(v[0], v[1]);
    const F cd = _mm512_unpacklo_ps(v[2], v[3]) + (F)_mm512_unpackhi_ps(v[2], v[3]);
    const F abcd = (F)_mm512_shuffle_ps(ab, cd, 0x44) + (F)_mm512_shuffle_ps(ab, cd, 0xee);
    sums[half] = fold(abcd);
  }
#else
  sums[0] = sums_of_four(v[0], v[1], v[2], v[3]);
  sums[1] = sums_of_four(v[4], v[5], v[6], v[7]);
#endif
}

}  // namespace
