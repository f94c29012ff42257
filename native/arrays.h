// What the bindings share: contiguous arrays on the CPU, and checks of arguments.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace nb = nanobind;

template <typename T, typename... Shape>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;

template <int... Shape>
using In = Array<const float, nb::shape<Shape...>>;
template <int... Shape>
using Out = Array<float, nb::shape<Shape...>>;

inline void require(bool condition, const char* message) {
  if (!condition) throw nb::value_error(message);
}
