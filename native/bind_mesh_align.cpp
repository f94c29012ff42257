#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.h"
#include "mesh_align.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Points = Array<const float, nb::shape<-1, 3>>;
using Faces = Array<const int64_t, nb::shape<-1, 3>>;
using Picture = Array<const float, nb::shape<-1, -1, 3>>;
using Plane = Array<const float, nb::ndim<2>>;
using Matrix3 = Array<const float, nb::shape<3, 3>>;
using Matrix4 = Array<const float, nb::shape<4, 4>>;
using Light = Array<const float, nb::shape<9, 3>>;

// What stays the same over the frames of a sequence, checked once.
class AlignSurface {
 public:
  AlignSurface(const Faces& faces, Array<const float, nb::shape<-1, 3, 2>> uv, Array<const uint8_t, nb::ndim<1>> used,
               Picture albedo, Plane trust, float sigma, float outlier, float least_cosine)
      : faces_(faces.data(), faces.data() + faces.size()),
        uv_(std::move(uv)),
        used_(std::move(used)),
        albedo_(std::move(albedo)),
        trust_(std::move(trust)),
        options_{sigma, outlier, least_cosine} {
    const int face_count = checked_length(faces.shape(0), "triangles");
    require(uv_.shape(0) == faces.shape(0) && used_.shape(0) == faces.shape(0), "uv and used must have a row a face");
    require(has_shape(albedo_, trust_.shape(0), trust_.shape(1), 3) && trust_.size() > 0,
            "albedo and trust must be of one texture");
    const PictureSize texture = picture_size(trust_);
    check_indices(faces, std::numeric_limits<int32_t>::max(), "a face names a vertex that does not exist");
    if (face_count > 0) vertices_ = *std::max_element(faces_.begin(), faces_.end()) + 1;
    surface_ = {uv_.data(), used_.data(), albedo_.data(), trust_.data(), texture.width, texture.height};
  }

  mien::Mesh mesh(const Points& vertices) const {
    const int count = checked_length(vertices.shape(0), "vertices");
    if (count < vertices_) throw std::out_of_range("a face names a vertex that does not exist");
    return {vertices.data(), count, faces_.data(), static_cast<int64_t>(faces_.size() / 3)};
  }

  const mien::TexturedSurface& surface() const { return surface_; }
  const mien::AlignOptions& options() const { return options_; }

 private:
  std::vector<int64_t> faces_;  // its own, so that nobody changes what was checked
  Array<const float, nb::shape<-1, 3, 2>> uv_;
  Array<const uint8_t, nb::ndim<1>> used_;
  Picture albedo_;
  Plane trust_;
  mien::AlignOptions options_;
  mien::TexturedSurface surface_;
  int64_t vertices_ = 0;  // that the faces name
};

mien::AlignFrame frame_of(const Points& vertices, const Points& normals, const Matrix3& K, const Matrix4& viewmat,
                          const Picture& image, const Plane& mask, const Light& light) {
  const PictureSize size = picture_size(image);
  require(normals.shape(0) == vertices.shape(0), "normals must have a row a vertex");
  require(has_shape(mask, size.height, size.width), "image and mask must be of one picture");
  return {{K.data(), viewmat.data(), size.width, size.height}, normals.data(), image.data(), mask.data(), light.data()};
}

std::pair<double, double> align_mesh(const AlignSurface& surface, const Points& vertices, const Points& normals,
                                     const Matrix3& K, const Matrix4& viewmat, const Picture& image, const Plane& mask,
                                     const Light& light, int high_pass,
                                     const std::optional<Array<const float, nb::shape<-1, 3, -1>>>& jacobian,
                                     const std::optional<Array<float, nb::ndim<2>>>& hessian,
                                     const std::optional<Array<float, nb::ndim<1>>>& gradient,
                                     const std::optional<Array<float, nb::shape<-1, -1, 3>>>& residual,
                                     const std::optional<Array<float, nb::shape<-1, -1, 3>>>& smooth) {
  const bool derive = jacobian.has_value();
  require(derive == hessian.has_value() && derive == gradient.has_value(),
          "jacobian, hessian and gradient go together");
  const int parameters = derive ? checked_length(jacobian->shape(2), "parameters") : 0;
  require(!derive || (jacobian->shape(0) == vertices.shape(0) && has_shape(*hessian, parameters, parameters) &&
                      has_shape(*gradient, parameters)),
          "jacobian, hessian and gradient must agree on vertices and parameters");
  require((!residual || same_shape(*residual, image)) && (!smooth || same_shape(*smooth, image)),
          "residual and smooth must be of the picture's size");
  require(high_pass >= 0, "high_pass is a number of pixels, or 0");
  const mien::Mesh mesh = surface.mesh(vertices);
  const mien::AlignFrame frame = frame_of(vertices, normals, K, viewmat, image, mask, light);
  const mien::AlignBuffers out{derive ? hessian->data() : nullptr, derive ? gradient->data() : nullptr,
                               residual ? residual->data() : nullptr, smooth ? smooth->data() : nullptr};
  const nb::gil_scoped_release release;
  const mien::AlignResult result = mien::align_mesh(mesh, surface.surface(), frame, surface.options(), {high_pass},
                                                    derive ? jacobian->data() : nullptr, parameters, out);
  return {result.cost, result.weight};
}

void bake_texture(const AlignSurface& surface, const Points& vertices, const Points& normals, const Matrix3& K,
                  const Matrix4& viewmat, const Picture& image, const Plane& mask, const Light& light,
                  const Array<const int32_t, nb::ndim<2>>& texel_face, const Picture& texel_barycentric,
                  const Array<float, nb::ndim<2>>& weight, const Array<float, nb::ndim<3>>& squares,
                  const Array<float, nb::ndim<3>>& mixed, const Array<float, nb::ndim<3>>& image_squares) {
  const mien::TexturedSurface& textured = surface.surface();
  const int rows = textured.texture_height, columns = textured.texture_width;
  const mien::Mesh mesh = surface.mesh(vertices);
  require(has_shape(texel_face, rows, columns) && has_shape(texel_barycentric, rows, columns, 3) &&
              has_shape(weight, rows, columns) && has_shape(squares, rows, columns, 3) && same_shape(mixed, squares) &&
              same_shape(image_squares, squares),
          "texels and sums must be of the texture's size");
  const mien::AlignFrame frame = frame_of(vertices, normals, K, viewmat, image, mask, light);
  const nb::gil_scoped_release release;
  check_indices(texel_face, mesh.face_count, "the texels name a triangle that does not exist", -1);
  mien::bake_texture(mesh, textured, frame, surface.options(), {texel_face.data(), texel_barycentric.data()},
                     {weight.data(), squares.data(), mixed.data(), image_squares.data()});
}

void light_equations(const AlignSurface& surface, const Points& vertices, const Points& normals, const Matrix3& K,
                     const Matrix4& viewmat, const Picture& image, const Plane& mask, const Light& light,
                     const Array<double, nb::shape<3, 9, 9>>& hessian, const Array<double, nb::shape<3, 9>>& right) {
  const mien::Mesh mesh = surface.mesh(vertices);
  const mien::AlignFrame frame = frame_of(vertices, normals, K, viewmat, image, mask, light);
  const nb::gil_scoped_release release;
  mien::light_equations(mesh, surface.surface(), frame, surface.options(), hessian.data(), right.data());
}

}  // namespace

void bind_mesh_align(nb::module_& module) {
  nb::class_<AlignSurface>(module, "AlignSurface")
      .def(nb::init<const Faces&, Array<const float, nb::shape<-1, 3, 2>>, Array<const uint8_t, nb::ndim<1>>, Picture,
                    Plane, float, float, float>(),
           "faces"_a.noconvert(), "uv"_a.noconvert(), "used"_a.noconvert(), "albedo"_a.noconvert(),
           "trust"_a.noconvert(), "sigma"_a, "outlier"_a, "least_cosine"_a);
  module.def("align_mesh", &align_mesh, "surface"_a, "vertices"_a.noconvert(), "normals"_a.noconvert(),
             "K"_a.noconvert(), "viewmat"_a.noconvert(), "image"_a.noconvert(), "mask"_a.noconvert(),
             "light"_a.noconvert(), "high_pass"_a, "jacobian"_a.none(), "hessian"_a.none(), "gradient"_a.none(),
             "residual"_a.none(), "smooth"_a.none());
  module.def("bake_texture", &bake_texture, "surface"_a, "vertices"_a.noconvert(), "normals"_a.noconvert(),
             "K"_a.noconvert(), "viewmat"_a.noconvert(), "image"_a.noconvert(), "mask"_a.noconvert(),
             "light"_a.noconvert(), "texel_face"_a.noconvert(), "texel_barycentric"_a.noconvert(),
             "weight"_a.noconvert(), "squares"_a.noconvert(), "mixed"_a.noconvert(), "image_squares"_a.noconvert());
  module.def("light_equations", &light_equations, "surface"_a, "vertices"_a.noconvert(), "normals"_a.noconvert(),
             "K"_a.noconvert(), "viewmat"_a.noconvert(), "image"_a.noconvert(), "mask"_a.noconvert(),
             "light"_a.noconvert(), "hessian"_a.noconvert(), "right"_a.noconvert());
}
