#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <memory>
#include <new>
#include <stdexcept>
#include <vector>

#include "arrays.h"
#include "memory.h"

using namespace nb::literals;

namespace {

using Shape = std::vector<size_t>;

struct Made;

// PyTorch's functions for other libraries: the beginning of DLPackExchangeAPI, of DLPack 1.
struct Exchange {
  uint32_t major, minor;
  void* before;
  void *allocate, *share;
  int (*adopt)(Made* managed, void** tensor);
  int (*look_at)(void* tensor, nb::dlpack::dltensor* found);
};

const Exchange& exchange() {
  static const auto* const one = [] {
    const nb::object table = nb::module_::import_("torch").attr("Tensor").attr("__dlpack_c_exchange_api__");
    const auto* const found = static_cast<const Exchange*>(PyCapsule_GetPointer(table.ptr(), "dlpack_exchange_api"));
    if (!found) throw nb::python_error();
    if (found->major != 1 || !found->adopt || !found->look_at)
      throw std::runtime_error("PyTorch's DLPack is of another version");
    return found;
  }();
  return *one;
}

// DLPack's form of a tensor that stays alive as long as the core reads it.
struct Shown {
  nb::dlpack::dltensor tensor;
  nb::handle owner;
  void (*forget)(Shown*);
};

void forget(Shown* shown) {
  const nb::gil_scoped_acquire guard;
  shown->owner.dec_ref();
  delete shown;
}

void forget_capsule(PyObject* capsule) {
  if (!PyCapsule_IsValid(capsule, "dltensor")) return;  // an array of the core owns it
  forget(static_cast<Shown*>(PyCapsule_GetPointer(capsule, "dltensor")));
}

// Fails for what is no tensor: PyTorch does not look.
nb::object shown(nb::handle tensor) {
  static const nb::handle kind = nb::object(nb::module_::import_("torch").attr("Tensor")).release();
  if (PyObject_IsInstance(tensor.ptr(), kind.ptr()) != 1) throw nb::type_error("the core takes tensors");
  auto one = std::make_unique<Shown>();
  if (exchange().look_at(tensor.ptr(), &one->tensor) != 0) throw nb::python_error();
  one->forget = forget;
  nb::object capsule = nb::steal(PyCapsule_New(one.get(), "dltensor", forget_capsule));
  if (!capsule.is_valid()) throw nb::python_error();
  one.release()->owner = nb::borrow(tensor).release();
  return capsule;
}

nb::list unpacked(nb::args tensors) {
  nb::list found;
  for (const nb::handle tensor : tensors) found.append(tensor.is_none() ? nb::none() : shown(tensor));
  return found;
}

constexpr int kMostAxes = 4;

// DLPack's form of a tensor that the core made: DLManagedTensorVersioned.
struct Made {
  uint32_t major = 1, minor = 0;
  void* context = nullptr;
  void (*forget)(Made*) = [](Made* made) { delete made; };
  uint64_t flags = 0;
  nb::dlpack::dltensor tensor;
  int64_t shape[kMostAxes], strides[kMostAxes];
  mien::Recycled<float> memory;

  explicit Made(size_t count) : memory(count) {}
};

nb::object recycled(const Shape& shape) {
  constexpr size_t kMost = SIZE_MAX / 8;
  require(shape.size() <= kMostAxes, "a tensor of the core has at most 4 axes");
  size_t count = 1;
  for (const size_t length : shape) {
    if (length > kMost || (length != 0 && count > kMost / length)) throw std::bad_alloc();
    count *= length;
  }
  auto made = std::make_unique<Made>(count);
  nb::dlpack::dltensor& tensor = made->tensor;
  tensor.data = made->memory.data();
  tensor.device = {nb::device::cpu::value, 0};
  tensor.ndim = static_cast<int32_t>(shape.size());
  tensor.dtype = nb::dtype<float>();
  tensor.shape = made->shape, tensor.strides = made->strides;
  int64_t stride = 1;
  for (size_t axis = shape.size(); axis-- > 0;) {
    made->shape[axis] = static_cast<int64_t>(shape[axis]), made->strides[axis] = stride;
    stride *= static_cast<int64_t>(shape[axis]);
  }
  void* found = nullptr;
  if (exchange().adopt(made.get(), &found) != 0) throw nb::python_error();
  made.release();
  return nb::steal(static_cast<PyObject*>(found));
}

}  // namespace

void bind_memory(nb::module_& module) {
  module.def("recycled", &recycled, "shape"_a,
             "A float32 tensor with undefined values whose memory is kept for the next one of that size.");
  module.def("unpacked", &unpacked, "Tensors on the CPU in the form of DLPack, each for one call; None stays None.");
}
