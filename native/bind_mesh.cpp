#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "arrays.h"
#include "mesh.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Vertices = Array<const float, nb::shape<-1, 3>>;
using Faces = Array<const int64_t, nb::shape<-1, 3>>;

void rasterize_mesh(const Vertices& vertices, const Faces& faces, const Array<const float, nb::shape<3, 3>>& K,
                    const Array<const float, nb::shape<4, 4>>& viewmat, bool cull_backfaces,
                    const Array<int32_t, nb::ndim<2>>& face_index, const Array<float, nb::ndim<3>>& barycentric,
                    const Array<float, nb::ndim<2>>& depth) {
  const PictureSize size = picture_size(face_index);
  require(has_shape(barycentric, size.height, size.width, 3) && same_shape(depth, face_index),
          "face_index, barycentric and depth must be of one picture");
  const int face_count = checked_length(faces.shape(0), "triangles");
  const nb::gil_scoped_release release;
  check_indices(faces, static_cast<int64_t>(vertices.shape(0)), "a face names a vertex that does not exist");
  const mien::Mesh mesh{vertices.data(), static_cast<int64_t>(vertices.shape(0)), faces.data(), face_count};
  const mien::MeshView view{K.data(), viewmat.data(), size.width, size.height};
  mien::rasterize_mesh(mesh, view, cull_backfaces, {face_index.data(), barycentric.data(), depth.data()});
}

void interpolate_mesh(const Array<const int32_t, nb::ndim<2>>& face_index,
                      const Array<const float, nb::ndim<3>>& barycentric,
                      const Array<const float, nb::ndim<2>>& attributes, const Faces& corners,
                      const Array<float, nb::ndim<3>>& out) {
  const PictureSize size = picture_size(face_index);
  const int channels = checked_length(attributes.shape(1), "numbers a vertex");
  require(has_shape(out, size.height, size.width, channels) && has_shape(barycentric, size.height, size.width, 3),
          "out must hold one row of attributes a pixel");
  const nb::gil_scoped_release release;
  check_indices(corners, static_cast<int64_t>(attributes.shape(0)), "a face names a vertex that does not exist");
  check_indices(face_index, static_cast<int64_t>(corners.shape(0)), "the fragments name a triangle that does not exist",
                -1);
  mien::interpolate_mesh(face_index.data(), barycentric.data(), static_cast<int64_t>(face_index.size()),
                         attributes.data(), corners.data(), channels, out.data());
}

}  // namespace

void bind_mesh(nb::module_& module) {
  module.def("rasterize_mesh", &rasterize_mesh, "vertices"_a.noconvert(), "faces"_a.noconvert(), "K"_a.noconvert(),
             "viewmat"_a.noconvert(), "cull_backfaces"_a, "face_index"_a.noconvert(), "barycentric"_a.noconvert(),
             "depth"_a.noconvert());
  module.def("interpolate_mesh", &interpolate_mesh, "face_index"_a.noconvert(), "barycentric"_a.noconvert(),
             "attributes"_a.noconvert(), "corners"_a.noconvert(), "out"_a.noconvert());
}
