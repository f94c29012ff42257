#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.h"
#include "mesh.h"
#include "mesh_gradients.h"
#include "mesh_loss.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Points = Array<const float, nb::shape<-1, 3>>;
using Faces = Array<const int64_t, nb::shape<-1, 3>>;
using Rows = Array<const float, nb::ndim<2>>;
using Image = Array<const float, nb::ndim<3>>;
using ColorImage = Array<const float, nb::shape<-1, -1, 3>>;
using Gray = Array<const float, nb::ndim<2>>;
using FaceIndex = Array<const int32_t, nb::ndim<2>>;
using PointSums = Array<double, nb::shape<-1, 3>>;
template <typename T>
using Grad = std::optional<Array<T>>;

template <typename T, typename A>
T* data_or_null(const Grad<T>& gradient, const A& array, const char* message) {
  if (!gradient) return nullptr;
  require(same_shape(*gradient, array), message);
  return gradient->data();
}

struct FragmentNames {
  static constexpr char kName[] = "Fragments";
  static constexpr const char* kFields[] = {"face_index", "barycentric", "depth"};
};

// A drawn mesh, to be filled.
struct NewFragments : FragmentNames {
  Array<int32_t, nb::ndim<2>> face_index;
  Array<float, nb::ndim<3>> barycentric;
  Array<float, nb::ndim<2>> depth;
  PictureSize size;

  explicit NewFragments(const Group<NewFragments>& group) {
    group.read(face_index, barycentric, depth);
    size = picture_size(face_index);
    require(has_shape(barycentric, size.height, size.width, 3) && same_shape(depth, face_index),
            "face_index, barycentric and depth must be of one picture");
  }
};

// A drawn mesh.
struct Fragments : FragmentNames {
  FaceIndex face_index;
  Image barycentric;
  Gray depth;
  PictureSize size;

  explicit Fragments(const Group<Fragments>& group) {
    group.read(face_index, barycentric, depth);
    size = picture_size(face_index);
    require(has_shape(barycentric, size.height, size.width, 3) && same_shape(depth, face_index),
            "face_index, barycentric and depth must be of one picture");
  }
  mien::Fragments of(const mien::ImageMesh& mesh) const {
    check_indices(face_index, mesh.face_count, "the fragments name a triangle that does not exist", -1);
    return {face_index.data(), barycentric.data(), depth.data(), size.width, size.height};
  }
};

mien::ImageMesh mesh_of(const Points& points, const Faces& faces) {
  const int point_count = checked_length(points.shape(0), "vertices");
  const int face_count = checked_length(faces.shape(0), "triangles");
  check_indices(faces, point_count, "a face names a vertex that does not exist");
  return {points.data(), point_count, faces.data(), face_count};
}

// The edges of a mesh, each with one or two triangles and the vertex opposite in the first.
struct MeshEdges {
  static constexpr char kName[] = "MeshEdges";
  static constexpr const char* kFields[] = {"vertices", "faces", "opposite"};
  Array<const int32_t, nb::shape<-1, 2>> vertices, faces;
  Array<const int32_t, nb::ndim<1>> opposite;

  explicit MeshEdges(const Group<MeshEdges>& group) { group.read(vertices, faces, opposite); }
  mien::MeshEdges of(const mien::ImageMesh& mesh) const {
    require(vertices.shape(0) == faces.shape(0) && opposite.shape(0) == faces.shape(0),
            "edges: vertices, faces and opposite must have one row per edge");
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
};

void rasterize_mesh(const Points& vertices, const Faces& faces, const In<3, 3>& K, const In<4, 4>& viewmat,
                    bool cull_backfaces, const Group<NewFragments>& fragment_group) {
  const NewFragments fragments(fragment_group);
  const int face_count = checked_length(faces.shape(0), "triangles");
  const nb::gil_scoped_release release;
  check_indices(faces, static_cast<int64_t>(vertices.shape(0)), "a face names a vertex that does not exist");
  const mien::Mesh mesh{vertices.data(), static_cast<int64_t>(vertices.shape(0)), faces.data(), face_count};
  const mien::MeshView view{K.data(), viewmat.data(), fragments.size.width, fragments.size.height};
  mien::rasterize_mesh(mesh, view, cull_backfaces,
                       {fragments.face_index.data(), fragments.barycentric.data(), fragments.depth.data()});
}

void interpolate_mesh(const FaceIndex& face_index, const Image& barycentric, const Rows& attributes,
                      const Faces& corners, const Array<float, nb::ndim<3>>& out) {
  const PictureSize size = picture_size(face_index);
  const int channels = checked_length(attributes.shape(1), "numbers per vertex");
  require(has_shape(out, size.height, size.width, channels) && has_shape(barycentric, size.height, size.width, 3),
          "out must hold one row of attributes per pixel");
  const nb::gil_scoped_release release;
  check_indices(corners, static_cast<int64_t>(attributes.shape(0)), "a face names a vertex that does not exist");
  check_indices(face_index, static_cast<int64_t>(corners.shape(0)), "the fragments name a triangle that does not exist",
                -1);
  mien::interpolate_mesh(face_index.data(), barycentric.data(), static_cast<int64_t>(face_index.size()),
                         attributes.data(), corners.data(), channels, out.data());
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
  require(has_shape(out, uv.shape(0), texture.shape(2)), "out must hold one colour per point");
  const nb::gil_scoped_release release;
  mien::sample_texture(view, uv.data(), static_cast<int64_t>(uv.shape(0)), out.data());
}

// What `mesh_loss` draws: normals at the vertices, a texture, and the light.
struct LitSurface {
  static constexpr char kName[] = "LitSurface";
  static constexpr const char* kFields[] = {"normals", "uv", "face_weights", "texture", "light"};
  Points normals;
  In<-1, 3, 2> uv;
  In<-1> face_weights;
  ColorImage texture;
  In<9, 3> light;

  explicit LitSurface(const Group<LitSurface>& group) { group.read(normals, uv, face_weights, texture, light); }
  mien::LitSurface view() const {
    return {normals.data(), uv.data(), face_weights.data(), texture_of(texture), light.data()};
  }
};

// What `mesh_loss` compares it with.
struct LossTarget {
  static constexpr char kName[] = "LossTarget";
  static constexpr const char* kFields[] = {"image", "mask", "epsilon"};
  ColorImage image;
  Gray mask;
  float epsilon = 0;

  explicit LossTarget(const Group<LossTarget>& group) { group.read(image, mask, epsilon); }
};

// Gradients of `mesh_loss`, which are added to.
struct LossGradients {
  static constexpr char kName[] = "LossGradients";
  static constexpr const char* kFields[] = {"points", "normals", "texture", "light"};
  PointSums points;
  Out<-1, 3> normals;
  Out<-1, -1, 3> texture;
  Array<double, nb::shape<9, 3>> light;

  explicit LossGradients(const Group<LossGradients>& group) { group.read(points, normals, texture, light); }
};

std::pair<double, double> mesh_loss(const Group<Fragments>& fragment_group, const Points& points, const Faces& faces,
                                    const Group<MeshEdges>& edge_group, const Group<LitSurface>& surface_group,
                                    const Group<LossTarget>& target_group, const Grad<float>& picture,
                                    const Group<LossGradients>& gradient_group) {
  const Fragments fragments(fragment_group);
  const MeshEdges edges(edge_group);
  const LitSurface surface(surface_group);
  const LossTarget target(target_group);
  const LossGradients gradients(gradient_group);
  require(same_shape(surface.normals, points) && same_shape(gradients.points, points) &&
              same_shape(gradients.normals, points) && surface.uv.shape(0) == faces.shape(0) &&
              surface.face_weights.shape(0) == faces.shape(0) &&
              has_shape(target.image, fragments.size.height, fragments.size.width, 3) &&
              same_shape(target.mask, fragments.face_index) && same_shape(gradients.texture, surface.texture),
          "mesh_loss: the arrays do not belong together");
  float* drawn = data_or_null(picture, target.image, "picture has another size");
  const mien::LitSurface view = surface.view();
  const nb::gil_scoped_release release;
  const mien::ImageMesh mesh = mesh_of(points, faces);
  const mien::LossValue value = mien::mesh_loss(
      fragments.of(mesh), mesh, edges.of(mesh), view, {target.image.data(), target.mask.data(), target.epsilon}, drawn,
      {gradients.points.data(), gradients.normals.data(), gradients.texture.data(), gradients.light.data()});
  return {value.sum, value.weight};
}

}  // namespace

void bind_mesh(nb::module_& module) {
  bind_group<Fragments>(module);
  bind_group<MeshEdges>(module);
  bind_group<LitSurface>(module);
  bind_group<LossTarget>(module);
  bind_group<LossGradients>(module);
  module.def("rasterize_mesh", &rasterize_mesh, "vertices"_a, "faces"_a, "K"_a, "viewmat"_a, "cull_backfaces"_a,
             "fragments"_a);
  module.def("interpolate_mesh", &interpolate_mesh, "face_index"_a, "barycentric"_a, "attributes"_a, "corners"_a,
             "out"_a);
  module.def("sample_texture", &sample_texture, "texture"_a, "uv"_a, "out"_a);
  module.def("mesh_loss", &mesh_loss, "fragments"_a, "points"_a, "faces"_a, "edges"_a, "surface"_a, "target"_a,
             "picture"_a.none(), "gradients"_a);
}
