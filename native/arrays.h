// The arguments of bindings: contiguous arrays on the CPU, named groups of them, and checks. No argument from Python
// may make the core read or write beyond an array, so each binding checks all sizes and indices.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

#include "rasterize.h"

namespace nb = nanobind;

template <typename T, typename... Shape>
using PlainArray = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;

// An array that is aligned and never a converted copy, since a result written to a copy would be lost.
template <typename T, typename... Shape>
class Array : public PlainArray<T, Shape...> {
 public:
  using Plain = PlainArray<T, Shape...>;

  Array() = default;
  explicit Array(Plain&& plain) : Plain(std::move(plain)) {}
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
    value = Own(std::move(plain.value));
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

// Refuses indices outside `least` .. count - 1. The loop has no branch, so that it handles several at a time: the
// highest bit is set if index - least or count - 1 - index is negative.
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

// For each Gaussian, a row of a table.
using Rows = Array<const int64_t, nb::ndim<1>>;

// The rows of `count` Gaussians in a table of so many; null stands for the first row.
inline const int64_t* checked_rows(const std::optional<Rows>& rows, size_t count, size_t of) {
  require(of >= 1, "a table must have a row");
  if (!rows) return nullptr;
  require(rows->shape(0) == count, "there must be a row for each Gaussian");
  check_indices(*rows, static_cast<int64_t>(of), "a Gaussian names a row that does not exist");
  return rows->data();
}

// Arguments that belong together, as Python passes them: a tuple, usually the named one that `bind_group` makes. `T`
// names the group (kName) and its fields (kFields), and its constructor reads them.
template <typename T>
struct Group {
  nb::tuple items;

  // Reads all fields, in the order of kFields. Errors name the field that does not fit.
  template <typename... Fields>
  void read(Fields&... fields) const {
    static_assert(sizeof...(Fields) == std::size(T::kFields));
    if (items.size() != sizeof...(Fields)) {
      throw nb::type_error((std::string(T::kName) + " has " + std::to_string(sizeof...(Fields)) + " items, not " +
                            std::to_string(items.size()))
                               .c_str());
    }
    size_t index = 0;
    (read_field(index++, fields), ...);
  }

 private:
  template <typename Field>
  void read_field(size_t index, Field& field) const {
    const nb::handle item = items[index].ptr();
    if (nb::try_cast<Field>(item, field, std::is_arithmetic_v<Field>)) return;
    throw nb::type_error((std::string(T::kName) + "." + T::kFields[index] + " has the wrong type or shape").c_str());
  }
};

namespace nanobind::detail {
template <typename T>
struct type_caster<Group<T>> {
  NB_TYPE_CASTER(Group<T>, const_name(T::kName))

  bool from_python(handle source, uint32_t, cleanup_list*) noexcept {
    if (!PyTuple_Check(source.ptr())) return false;
    value.items = nb::borrow<nb::tuple>(source);
    return true;
  }
};
}  // namespace nanobind::detail

// Defines the named tuple that Python passes as a `Group<T>`.
template <typename T>
void bind_group(nb::module_& module) {
  nb::list fields;
  for (const char* field : T::kFields) fields.append(field);
  const nb::object named_tuple = nb::module_::import_("collections").attr("namedtuple");
  module.attr(T::kName) = named_tuple(T::kName, fields, nb::arg("module") = module.attr("__name__"));
}
