#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <stdexcept>

#include "arrays.h"
#include "mesh.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Vertices = Array<const float, nb::shape<-1, 3>>;
using Faces = Array<const int64_t, nb::shape<-1, 3>>;

void check_indices(const Faces& faces, int64_t count) {
  const auto in_range = [count](int64_t index) { return index >= 0 && index < count; };
  if (!std::all_of(faces.data(), faces.data() + faces.size(), in_range)) {
    throw std::out_of_range("a face names a vertex that does not exist");
  }
}

void rasterize_mesh(const Vertices& vertices, const Faces& faces, const Array<const float, nb::shape<3, 3>>& K,
                    const Array<const float, nb::shape<4, 4>>& viewmat, bool cull_backfaces,
                    const Array<int32_t, nb::ndim<2>>& face_index, const Array<float, nb::ndim<3>>& barycentric,
                    const Array<float, nb::ndim<2>>& depth) {
  if (barycentric.size() != 3 * face_index.size() || depth.size() != face_index.size()) {
    throw nb::value_error("face_index, barycentric and depth must be of one picture");
  }
  const nb::gil_scoped_release release;
  check_indices(faces, static_cast<int64_t>(vertices.shape(0)));
  const mien::Mesh mesh{vertices.data(), static_cast<int64_t>(vertices.shape(0)), faces.data(),
                        static_cast<int64_t>(faces.shape(0))};
  const mien::MeshView view{K.data(), viewmat.data(), static_cast<int>(face_index.shape(1)),
                            static_cast<int>(face_index.shape(0))};
  mien::rasterize_mesh(mesh, view, cull_backfaces, {face_index.data(), barycentric.data(), depth.data()});
}

void interpolate_mesh(const Array<const int32_t, nb::ndim<2>>& face_index,
                      const Array<const float, nb::ndim<3>>& barycentric,
                      const Array<const float, nb::ndim<2>>& attributes, const Faces& corners,
                      const Array<float, nb::ndim<3>>& out) {
  if (out.size() != face_index.size() * attributes.shape(1) || barycentric.size() != 3 * face_index.size()) {
    throw nb::value_error("out must hold one row of attributes a pixel");
  }
  const nb::gil_scoped_release release;
  check_indices(corners, static_cast<int64_t>(attributes.shape(0)));
  const int32_t* last = std::max_element(face_index.data(), face_index.data() + face_index.size());
  if (face_index.size() > 0 && *last >= static_cast<int64_t>(corners.shape(0))) {
    throw std::out_of_range("the fragments name a triangle that does not exist");
  }
  mien::interpolate_mesh(face_index.data(), barycentric.data(), static_cast<int64_t>(face_index.size()),
                         attributes.data(), corners.data(), static_cast<int>(attributes.shape(1)), out.data());
}

}  // namespace

void bind_mesh(nb::module_& module) {
  module.def("rasterize_mesh", &rasterize_mesh, "vertices"_a.noconvert(), "faces"_a.noconvert(), "K"_a.noconvert(),
             "viewmat"_a.noconvert(), "cull_backfaces"_a, "face_index"_a.noconvert(), "barycentric"_a.noconvert(),
             "depth"_a.noconvert());
  module.def("interpolate_mesh", &interpolate_mesh, "face_index"_a.noconvert(), "barycentric"_a.noconvert(),
             "attributes"_a.noconvert(), "corners"_a.noconvert(), "out"_a.noconvert());
}
