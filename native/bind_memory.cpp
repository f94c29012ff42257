#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <memory>
#include <new>
#include <vector>

#include "memory.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

nb::ndarray<nb::pytorch, float, nb::device::cpu> recycled(const std::vector<size_t>& shape) {
  constexpr size_t kMost = SIZE_MAX / 8;
  size_t count = 1;
  for (const size_t length : shape) {
    if (length > kMost || (length != 0 && count > kMost / length)) throw std::bad_alloc();
    count *= length;
  }
  using Memory = mien::Recycled<float>;
  auto memory = std::make_unique<Memory>(count);
  const nb::capsule owner(memory.get(), [](void* own) noexcept { delete static_cast<Memory*>(own); });
  return {memory.release()->data(), shape.size(), shape.data(), owner};
}

}  // namespace

void bind_memory(nb::module_& module) {
  module.def("recycled", &recycled, "shape"_a,
             "A float32 tensor with undefined values whose memory is kept for the next one of that size.");
}
