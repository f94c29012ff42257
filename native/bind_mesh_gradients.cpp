#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>
#include <stdexcept>
#include <utility>

#include "arrays.h"
#include "mesh_gradients.h"
#include "mesh_loss.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Rows = Array<const float, nb::ndim<2>>;
using Image = Array<const float, nb::ndim<3>>;
using Gray = Array<const float, nb::ndim<2>>;
using Points = Array<const float, nb::shape<-1, 3>>;
using Faces = Array<const int64_t, nb::shape<-1, 3>>;
using Pairs = Array<const int32_t, nb::shape<-1, 2>>;
template <typename T>
using Grad = std::optional<Array<T>>;

template <typename T, typename A>
T* data_or_null(const Grad<T>& gradient, const A& array, const char* message) {
  if (!gradient) return nullptr;
  require(same_shape(*gradient, array), message);
  return gradient->data();
}

mien::Fragments fragments_of(const Array<const int32_t, nb::ndim<2>>& face_index, const Image& barycentric,
                             const Gray& depth, int64_t faces) {
  const PictureSize size = picture_size(face_index);
  require(has_shape(barycentric, size.height, size.width, 3) && same_shape(depth, face_index),
          "face_index, barycentric and depth must be of one picture");
  check_indices(face_index, faces, "the fragments name a triangle that does not exist", -1);
  return {face_index.data(), barycentric.data(), depth.data(), size.width, size.height};
}

mien::ImageMesh mesh_of(const Points& points, const Faces& faces) {
  const int point_count = checked_length(points.shape(0), "vertices");
  const int face_count = checked_length(faces.shape(0), "triangles");
  check_indices(faces, point_count, "a face names a vertex that does not exist");
  return {points.data(), point_count, faces.data(), face_count};
}

mien::MeshEdges edges_of(const Pairs& vertices, const Pairs& faces, const Array<const int32_t, nb::ndim<1>>& opposite,
                         const mien::ImageMesh& mesh) {
  require(vertices.shape(0) == faces.shape(0) && opposite.shape(0) == faces.shape(0),
          "edges: vertices, faces and opposite must have one row an edge");
  const int count = checked_length(vertices.shape(0), "edges");
  check_indices(vertices, mesh.point_count, "an edge names a vertex that does not exist");
  check_indices(opposite, mesh.point_count, "an edge names a vertex that does not exist");
  check_indices(faces, mesh.face_count, "an edge names a triangle that does not exist", -1);
  for (int edge = 0; edge < count; ++edge) {  // only the second one may be missing
    if (faces.data()[2 * static_cast<int64_t>(edge)] < 0) {
      throw std::out_of_range("an edge names a triangle that does not exist");
    }
  }
  return {vertices.data(), faces.data(), opposite.data(), count};
}

using FaceIndex = Array<const int32_t, nb::ndim<2>>;
using Opposite = Array<const int32_t, nb::ndim<1>>;

void barycentric_backward(const FaceIndex& face_index, const Image& barycentric, const Gray& depth,
                          const Points& points, const Faces& faces, const Image& grad_barycentric,
                          const Array<double, nb::shape<-1, 3>>& grad_points) {
  require(same_shape(grad_barycentric, barycentric) && same_shape(grad_points, points),
          "gradients must have the sizes of what they are of");
  const nb::gil_scoped_release release;
  const mien::ImageMesh mesh = mesh_of(points, faces);
  mien::barycentric_backward(fragments_of(face_index, barycentric, depth, mesh.face_count), mesh,
                             grad_barycentric.data(), grad_points.data());
}

void interpolate_backward(const FaceIndex& face_index, const Image& barycentric, const Rows& attributes,
                          const Faces& corners, const Image& grad_out, const Grad<float>& grad_attributes,
                          const Grad<float>& grad_barycentric) {
  const int channels = checked_length(attributes.shape(1), "numbers a vertex");
  const PictureSize size = picture_size(face_index);
  require(has_shape(grad_out, size.height, size.width, channels) && has_shape(barycentric, size.height, size.width, 3),
          "grad_out must hold one row of attributes a pixel");
  float* by_attributes = data_or_null(grad_attributes, attributes, "grad_attributes has another size");
  float* by_barycentric = data_or_null(grad_barycentric, barycentric, "grad_barycentric has another size");
  const nb::gil_scoped_release release;
  check_indices(corners, static_cast<int64_t>(attributes.shape(0)), "a face names a vertex that does not exist");
  check_indices(face_index, static_cast<int64_t>(corners.shape(0)), "the fragments name a triangle that does not exist",
                -1);
  const mien::Fragments fragments{face_index.data(), barycentric.data(), nullptr, size.width, size.height};
  mien::interpolate_backward(fragments, attributes.data(), corners.data(), channels, grad_out.data(), by_attributes,
                             by_barycentric);
}

template <typename T>
mien::TextureView texture_of(const T& texture) {
  require(texture.size() > 0, "the texture is empty");
  const PictureSize size = picture_size(texture);
  return {texture.data(), size.width, size.height, checked_length(texture.shape(2), "channels")};
}

void sample_texture(const Image& texture, const Array<const float, nb::shape<-1, 2>>& uv,
                    const Array<float, nb::ndim<2>>& out) {
  const mien::TextureView view = texture_of(texture);
  require(has_shape(out, uv.shape(0), texture.shape(2)), "out must hold one colour a point");
  const nb::gil_scoped_release release;
  mien::sample_texture(view, uv.data(), static_cast<int64_t>(uv.shape(0)), out.data());
}

void sample_texture_backward(const Image& texture, const Array<const float, nb::shape<-1, 2>>& uv, const Rows& grad_out,
                             const Grad<float>& grad_texture, const Grad<float>& grad_uv) {
  const mien::TextureView view = texture_of(texture);
  require(has_shape(grad_out, uv.shape(0), texture.shape(2)), "grad_out must hold one colour a point");
  float* by_texels = data_or_null(grad_texture, texture, "grad_texture has another size");
  float* by_uv = data_or_null(grad_uv, uv, "grad_uv has another size");
  const nb::gil_scoped_release release;
  mien::sample_texture_backward(view, uv.data(), static_cast<int64_t>(uv.shape(0)), grad_out.data(), by_texels, by_uv);
}

void antialias(const FaceIndex& face_index, const Image& barycentric, const Gray& depth, const Points& points,
               const Faces& faces, const Pairs& edge_vertices, const Pairs& edge_faces, const Opposite& opposite,
               const Image& image, const Array<float, nb::ndim<3>>& out) {
  const int channels = checked_length(image.shape(2), "channels");
  require(has_shape(image, face_index.shape(0), face_index.shape(1), channels) && same_shape(out, image),
          "image and out must be of the fragments' size");
  const nb::gil_scoped_release release;
  const mien::ImageMesh mesh = mesh_of(points, faces);
  thread_local std::vector<mien::Crossing> crossings;
  mien::find_crossings(fragments_of(face_index, barycentric, depth, mesh.face_count), mesh,
                       edges_of(edge_vertices, edge_faces, opposite, mesh), crossings);
  mien::antialias(crossings, image.data(), static_cast<int64_t>(face_index.size()), channels, out.data());
}

void antialias_backward(const FaceIndex& face_index, const Image& barycentric, const Gray& depth, const Points& points,
                        const Faces& faces, const Pairs& edge_vertices, const Pairs& edge_faces,
                        const Opposite& opposite, const Image& image, const Image& grad_out,
                        const Array<float, nb::ndim<3>>& grad_image,
                        const Array<double, nb::shape<-1, 3>>& grad_points) {
  const int channels = checked_length(image.shape(2), "channels");
  require(has_shape(image, face_index.shape(0), face_index.shape(1), channels) && same_shape(grad_out, image) &&
              same_shape(grad_image, image) && same_shape(grad_points, points),
          "gradients must have the sizes of what they are of");
  const nb::gil_scoped_release release;
  const mien::ImageMesh mesh = mesh_of(points, faces);
  const mien::MeshEdges edges = edges_of(edge_vertices, edge_faces, opposite, mesh);
  thread_local std::vector<mien::Crossing> crossings;
  mien::find_crossings(fragments_of(face_index, barycentric, depth, mesh.face_count), mesh, edges, crossings);
  mien::antialias_backward(crossings, mesh, edges, image.data(), static_cast<int64_t>(face_index.size()), channels,
                           grad_out.data(), grad_image.data(), grad_points.data());
}

std::pair<double, double> mesh_loss(
    const FaceIndex& face_index, const Image& barycentric, const Gray& depth, const Points& points, const Faces& faces,
    const Pairs& edge_vertices, const Pairs& edge_faces, const Opposite& opposite, const Points& normals,
    const Array<const float, nb::shape<-1, 3, 2>>& uv, const Array<const float, nb::ndim<1>>& face_weights,
    const Array<const float, nb::shape<-1, -1, 3>>& texture, const Array<const float, nb::shape<9, 3>>& light,
    const Array<const float, nb::shape<-1, -1, 3>>& target, const Gray& mask, float epsilon, const Grad<float>& picture,
    const Array<double, nb::shape<-1, 3>>& grad_points, const Array<float, nb::shape<-1, 3>>& grad_normals,
    const Array<float, nb::shape<-1, -1, 3>>& grad_texture, const Array<double, nb::shape<9, 3>>& grad_light) {
  require(same_shape(normals, points) && same_shape(grad_points, points) && same_shape(grad_normals, points) &&
              uv.shape(0) == faces.shape(0) && face_weights.shape(0) == faces.shape(0) &&
              has_shape(target, face_index.shape(0), face_index.shape(1), 3) && same_shape(mask, face_index) &&
              same_shape(grad_texture, texture),
          "mesh_loss: arrays do not belong together");
  float* drawn = data_or_null(picture, target, "picture has another size");
  const mien::TextureView view = texture_of(texture);
  const nb::gil_scoped_release release;
  const mien::ImageMesh mesh = mesh_of(points, faces);
  const mien::MeshEdges edges = edges_of(edge_vertices, edge_faces, opposite, mesh);
  const mien::LossValue value = mien::mesh_loss(
      fragments_of(face_index, barycentric, depth, mesh.face_count), mesh, edges,
      {normals.data(), uv.data(), face_weights.data(), view, light.data()}, {target.data(), mask.data(), epsilon},
      drawn, {grad_points.data(), grad_normals.data(), grad_texture.data(), grad_light.data()});
  return {value.sum, value.weight};
}

}  // namespace

void bind_mesh_gradients(nb::module_& module) {
  module.def("barycentric_backward", &barycentric_backward, "face_index"_a.noconvert(), "barycentric"_a.noconvert(),
             "depth"_a.noconvert(), "points"_a.noconvert(), "faces"_a.noconvert(), "grad_barycentric"_a.noconvert(),
             "grad_points"_a.noconvert());
  module.def("interpolate_mesh_backward", &interpolate_backward, "face_index"_a.noconvert(),
             "barycentric"_a.noconvert(), "attributes"_a.noconvert(), "corners"_a.noconvert(), "grad_out"_a.noconvert(),
             "grad_attributes"_a.noconvert().none(), "grad_barycentric"_a.noconvert().none());
  module.def("sample_texture", &sample_texture, "texture"_a.noconvert(), "uv"_a.noconvert(), "out"_a.noconvert());
  module.def("sample_texture_backward", &sample_texture_backward, "texture"_a.noconvert(), "uv"_a.noconvert(),
             "grad_out"_a.noconvert(), "grad_texture"_a.noconvert().none(), "grad_uv"_a.noconvert().none());
  module.def("antialias", &antialias, "face_index"_a.noconvert(), "barycentric"_a.noconvert(), "depth"_a.noconvert(),
             "points"_a.noconvert(), "faces"_a.noconvert(), "edge_vertices"_a.noconvert(), "edge_faces"_a.noconvert(),
             "opposite"_a.noconvert(), "image"_a.noconvert(), "out"_a.noconvert());
  module.def("antialias_backward", &antialias_backward, "face_index"_a.noconvert(), "barycentric"_a.noconvert(),
             "depth"_a.noconvert(), "points"_a.noconvert(), "faces"_a.noconvert(), "edge_vertices"_a.noconvert(),
             "edge_faces"_a.noconvert(), "opposite"_a.noconvert(), "image"_a.noconvert(), "grad_out"_a.noconvert(),
             "grad_image"_a.noconvert(), "grad_points"_a.noconvert());
  module.def("mesh_loss", &mesh_loss, "face_index"_a.noconvert(), "barycentric"_a.noconvert(), "depth"_a.noconvert(),
             "points"_a.noconvert(), "faces"_a.noconvert(), "edge_vertices"_a.noconvert(), "edge_faces"_a.noconvert(),
             "opposite"_a.noconvert(), "normals"_a.noconvert(), "uv"_a.noconvert(), "face_weights"_a.noconvert(),
             "texture"_a.noconvert(), "light"_a.noconvert(), "target"_a.noconvert(), "mask"_a.noconvert(), "epsilon"_a,
             "picture"_a.noconvert().none(), "grad_points"_a.noconvert(), "grad_normals"_a.noconvert(),
             "grad_texture"_a.noconvert(), "grad_light"_a.noconvert());
}
