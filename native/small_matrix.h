// Products of small matrices in registers, for kernels that send blocks of points through a network. As simd.h, for
// files that are compiled once per instruction set.
#pragma once

#include "simd.h"

namespace mien::MIEN_ISA {
namespace {

constexpr int kRows = W == 16 ? 6 : 3;  // rows of a tile, so that tile and factors fit into the registers

// The addresses may be null if there is nothing to copy.
MIEN_INLINE void copy(float* to, const float* from, int64_t count) {
  if (count > 0) memcpy(to, from, sizeof(float) * count);
}

struct Matrix {
  const float* values;
  int64_t row, column;  // strides
};

// A tile of the product a b [R, V * W], added to `start` (a row stride of 0 repeats one row).
template <int R, int V>
MIEN_INLINE void tile(Matrix a, const float* b, int64_t b_row, int64_t depth, const float* start, int64_t start_row,
                      float* out, int64_t out_row) {
  F sums[R][V];
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < V; ++v) sums[r][v] = load(start + r * start_row + v * W);
  for (int64_t k = 0; k < depth; ++k) {
    F factors[V];
    for (int v = 0; v < V; ++v) factors[v] = load(b + k * b_row + v * W);
    for (int r = 0; r < R; ++r) {
      const F own = set1(a.values[r * a.row + k * a.column]);
      for (int v = 0; v < V; ++v) sums[r][v] = sums[r][v] + own * factors[v];
    }
  }
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < V; ++v) store(out + r * out_row + v * W, sums[r][v]);
}

template <int V>
void panel(Matrix a, int64_t rows, const float* b, int64_t b_row, int64_t depth, const float* start, int64_t start_row,
           float* out, int64_t out_row) {
  int64_t r = 0;
  for (; r + kRows <= rows; r += kRows) {
    tile<kRows, V>({a.values + r * a.row, a.row, a.column}, b, b_row, depth, start + r * start_row, start_row,
                   out + r * out_row, out_row);
  }
  for (; r < rows; ++r) {
    tile<1, V>({a.values + r * a.row, a.row, a.column}, b, b_row, depth, start + r * start_row, start_row,
               out + r * out_row, out_row);
  }
}

// out [rows, width] = start + a b, with `width` a whole number of vectors.
void multiply(Matrix a, int64_t rows, const float* b, int64_t width, int64_t depth, const float* start,
              int64_t start_row, float* out) {
  int64_t c = 0;
  for (; c + 4 * W <= width; c += 4 * W) panel<4>(a, rows, b + c, width, depth, start + c, start_row, out + c, width);
  for (; c + 2 * W <= width; c += 2 * W) panel<2>(a, rows, b + c, width, depth, start + c, start_row, out + c, width);
  for (; c < width; c += W) panel<1>(a, rows, b + c, width, depth, start + c, start_row, out + c, width);
}

MIEN_INLINE bool all_zero(const float* values, int64_t count) {
  int64_t i = 0;
  I seen{};  // NaN counts as a value
  for (; i + W <= count; i += W) seen = seen | bits(load(values + i));
  bool zero = !any(less(F{}, to_float(seen & 0x7fffffff)));
  for (; i < count; ++i) zero = zero && values[i] == 0;
  return zero;
}

// Adds the columns' sums over `count` rows to `sums`.
MIEN_INLINE void add_rows(const float* rows, int64_t count, int64_t width, float* sums) {
  for (int64_t c = 0; c < width; c += W) {
    F total = load(sums + c);
    for (int64_t i = 0; i < count; ++i) total = total + load(rows + i * width + c);
    store(sums + c, total);
  }
}

}  // namespace
}  // namespace mien::MIEN_ISA
