#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <memory>
#include <new>
#include <utility>
#include <vector>

#include "arrays.h"
#include "memory.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Tensor = nb::ndarray<nb::pytorch, float, nb::device::cpu>;
using Shape = std::vector<size_t>;

// The owner of recycled memory for a tensor, and where it begins.
std::pair<nb::capsule, float*> memory_of(const Shape& shape) {
  constexpr size_t kMost = SIZE_MAX / 8, kMostAxes = 64;
  require(shape.size() <= kMostAxes, "a tensor has at most 64 axes");
  size_t count = 1;
  for (const size_t length : shape) {
    if (length > kMost || (length != 0 && count > kMost / length)) throw std::bad_alloc();
    count *= length;
  }
  using Memory = mien::Recycled<float>;
  auto memory = std::make_unique<Memory>(count);
  nb::capsule owner(memory.get(), [](void* own) noexcept { delete static_cast<Memory*>(own); });
  return {std::move(owner), memory.release()->data()};
}

Tensor recycled(const Shape& shape) {
  const auto [owner, data] = memory_of(shape);
  return {data, shape.size(), shape.data(), owner};
}

std::pair<Tensor, Tensor> recycled_twice(const Shape& shape) {
  const auto [owner, data] = memory_of(shape);
  return {Tensor(data, shape.size(), shape.data(), owner), Tensor(data, shape.size(), shape.data(), owner)};
}

}  // namespace

void bind_memory(nb::module_& module) {
  module.def("recycled", &recycled, "shape"_a,
             "A float32 tensor with undefined values whose memory is kept for the next one of that size.");
  module.def("recycled_twice", &recycled_twice, "shape"_a, "Two tensors as that of `recycled` in the same memory.");
  module.def("release_memory", &mien::release_memory, "Gives memory that nothing uses back to the system.");
}
