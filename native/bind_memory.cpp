#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <new>
#include <vector>

#include "memory.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

struct Lease {
  void* memory;
  size_t bytes;
};

nb::ndarray<nb::pytorch, float, nb::device::cpu> recycled(const std::vector<size_t>& shape) {
  size_t bytes = sizeof(float);
  for (const size_t length : shape) bytes *= length;
  void* const memory = mien::take_memory(bytes);
  if (!memory) throw std::bad_alloc();
  const nb::capsule owner(new Lease{memory, bytes}, [](void* lease) noexcept {
    const auto* own = static_cast<Lease*>(lease);
    mien::give_memory(own->memory, own->bytes);
    delete own;
  });
  return {memory, shape.size(), shape.data(), owner};
}

}  // namespace

void bind_memory(nb::module_& module) {
  module.def("recycled", &recycled, "shape"_a,
             "A float32 tensor with undefined values whose memory is kept for the next one of that size.");
}
