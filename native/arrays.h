// What the bindings share: contiguous arrays on the CPU, and checks of arguments. Nothing that Python passes may make
// the core read or write beyond an array: sizes are compared here, indices wherever they come in.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>

#include "rasterize.h"

namespace nb = nanobind;

template <typename T, typename... Shape>
using PlainArray = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;

// As nanobind's own, but aligned, and never a converted copy: what is written to a copy would be lost.
template <typename T, typename... Shape>
class Array : public PlainArray<T, Shape...> {
 public:
  using Plain = PlainArray<T, Shape...>;

  Array() = default;
  explicit Array(const Plain& plain) : Plain(plain) {}
  bool is_aligned() const { return reinterpret_cast<uintptr_t>(this->data()) % alignof(T) == 0; }
};

namespace nanobind::detail {
template <typename T, typename... Shape>
struct type_caster<Array<T, Shape...>> {
  using Own = Array<T, Shape...>;
  using Plain = make_caster<typename Own::Plain>;
  NB_TYPE_CASTER(Own, Plain::Name)

  bool from_python(handle source, uint32_t flags, cleanup_list* cleanup) noexcept {
    Plain plain;
    if (!plain.from_python(source, flags & ~static_cast<uint32_t>(cast_flags::convert), cleanup)) return false;
    value = Own(plain.value);
    return value.is_aligned();
  }
};
}  // namespace nanobind::detail

template <int... Shape>
using In = Array<const float, nb::shape<Shape...>>;
template <int... Shape>
using Out = Array<float, nb::shape<Shape...>>;

inline void require(bool condition, const char* message) {
  if (!condition) throw nb::value_error(message);
}

// Whether an array has these lengths. Products of lengths are never compared: they may overflow.
template <typename A, typename... N>
bool has_shape(const A& array, N... lengths) {
  const size_t expected[] = {static_cast<size_t>(lengths)...};
  return array.ndim() == sizeof...(N) && std::equal(expected, expected + sizeof...(N), array.shape_ptr());
}
template <typename A, typename B>
bool same_shape(const A& a, const B& b) {
  return a.ndim() == b.ndim() && std::equal(a.shape_ptr(), a.shape_ptr() + a.ndim(), b.shape_ptr());
}

// A length as the core counts it.
inline int checked_length(size_t length, int64_t most, const char* what) {
  if (length > static_cast<size_t>(most)) {
    throw nb::value_error((std::to_string(length) + " " + what + "; at most " + std::to_string(most)).c_str());
  }
  return static_cast<int>(length);
}
inline int checked_length(size_t length, const char* what) {
  return checked_length(length, std::numeric_limits<int32_t>::max(), what);
}

struct PictureSize {
  int width, height;
};
// The size of a picture [h, w, ..], whose pixels are counted in 32 bits.
template <typename A>
PictureSize picture_size(const A& picture) {
  const int height = checked_length(picture.shape(0), mien::kMostPictureSide, "rows of pixels");
  const int width = checked_length(picture.shape(1), mien::kMostPictureSide, "columns of pixels");
  checked_length(static_cast<size_t>(height) * static_cast<size_t>(width), "pixels");
  return {width, height};
}

// Refuses indices beyond `least` .. count - 1. Several at a time, without a branch: the highest bit is set where an
// index, or what is left beyond it, is negative.
template <typename A>
void check_indices(const A& indices, int64_t count, const char* message, int64_t least = 0) {
  const auto* const values = indices.data();
  const size_t size = indices.size();
  uint64_t bits = 0;
  for (size_t i = 0; i < size; ++i) {
    const auto index = static_cast<uint64_t>(static_cast<int64_t>(values[i]));
    bits |= (index - static_cast<uint64_t>(least)) | (static_cast<uint64_t>(count) - 1 - index);
  }
  if (bits >> 63) throw std::out_of_range(message);
}

// Item `index` of a tuple whose length was checked.
template <typename T>
T item(const nb::tuple& tuple, size_t index, const char* name) {
  T value;
  if (nb::try_cast<T>(tuple[index], value, false)) return value;
  throw nb::type_error((std::string(name) + ": not the array that belongs there").c_str());
}
