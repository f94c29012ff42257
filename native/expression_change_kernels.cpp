// Compiled once per instruction set: one changed value per lane.
#include "expression_change_kernels.h"

#include "simd_columns.h"

namespace mien::MIEN_ISA {
namespace {

template <int RANK>
void change(const float* basis, const float* activations, int64_t count, float* out) {
  for (int64_t i = 0; i < count; i += W) {
    const int valid = count - i < W ? (int)(count - i) : W;
    F columns[RANK];
    load_columns<RANK>(basis + RANK * i, RANK, valid, columns);
    F sum = activations[0] * columns[0];
    for (int k = 1; k < RANK; ++k) sum = sum + activations[k] * columns[k];
    memcpy(out + i, &sum, sizeof(float) * valid);
  }
}

template <int RANK>
void backward(const float* basis, const float* activations, const float* gradient, int64_t count, float* grad_basis,
              double* sums) {
  F totals[RANK] = {};
  for (int64_t i = 0; i < count; i += W) {
    const int valid = count - i < W ? (int)(count - i) : W;
    F columns[RANK], by_value{};
    memcpy(&by_value, gradient + i, sizeof(float) * valid);
    load_columns<RANK>(basis + RANK * i, RANK, valid, columns);
    for (int k = 0; k < RANK; ++k) {
      totals[k] = totals[k] + by_value * columns[k];
      columns[k] = activations[k] * by_value;
    }
    store_columns<RANK>(grad_basis + RANK * i, RANK, valid, columns);
  }
  for (int k = 0; k < RANK; ++k) {
    sums[k] = 0;
    for (int lane = 0; lane < W; ++lane) sums[k] += totals[k][lane];
  }
}

}  // namespace

extern const ExpressionKernels expression_kernels;
const ExpressionKernels expression_kernels = {
    {change<1>, change<2>, change<3>, change<4>, change<5>, change<6>, change<7>, change<8>},
    {backward<1>, backward<2>, backward<3>, backward<4>, backward<5>, backward<6>, backward<7>, backward<8>}};

}  // namespace mien::MIEN_ISA
