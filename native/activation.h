// Elementwise functions whose rounding training and the runtime without torch must share.
#pragma once

#include <cstdint>

namespace mien {

// out = 1 / (1 + exp(-values)), to 1.5e-7 (absolute) and 4e-6 (relative, above 1e-29); NaN stays NaN. Runs on the pool.
void sigmoid(const float* values, int64_t count, float* out);
// out = gradient * outputs * (1 - outputs), where `outputs` are the sigmoid's. Runs on the pool.
void sigmoid_backward(const float* outputs, const float* gradient, int64_t count, float* out);

}  // namespace mien
