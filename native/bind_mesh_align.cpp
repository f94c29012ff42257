#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <utility>

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
  AlignSurface(Faces faces, Array<const float, nb::shape<-1, 3, 2>> uv, Array<const uint8_t, nb::ndim<1>> used,
               Picture albedo, Plane trust, float sigma, float outlier, float least_cosine)
      : faces_(std::move(faces)),
        uv_(std::move(uv)),
        used_(std::move(used)),
        albedo_(std::move(albedo)),
        trust_(std::move(trust)),
        options_{sigma, outlier, least_cosine} {
    if (uv_.shape(0) != faces_.shape(0) || used_.shape(0) != faces_.shape(0)) {
      throw nb::value_error("uv and used must have a row a face");
    }
    if (albedo_.shape(0) != trust_.shape(0) || albedo_.shape(1) != trust_.shape(1) || trust_.size() == 0) {
      throw nb::value_error("albedo and trust must be of one texture");
    }
    for (size_t i = 0; i < faces_.size(); ++i) {
      if (faces_.data()[i] < 0) throw std::out_of_range("a face names a vertex that does not exist");
      vertices_ = std::max(vertices_, faces_.data()[i] + 1);
    }
  }

  mien::Mesh mesh(const Points& vertices) const {
    if (static_cast<int64_t>(vertices.shape(0)) < vertices_) {
      throw std::out_of_range("a face names a vertex that does not exist");
    }
    return {vertices.data(), static_cast<int64_t>(vertices.shape(0)), faces_.data(),
            static_cast<int64_t>(faces_.shape(0))};
  }

  mien::TexturedSurface surface() const {
    return {uv_.data(),
            used_.data(),
            albedo_.data(),
            trust_.data(),
            static_cast<int>(albedo_.shape(1)),
            static_cast<int>(albedo_.shape(0))};
  }

  const mien::AlignOptions& options() const { return options_; }

 private:
  Faces faces_;
  Array<const float, nb::shape<-1, 3, 2>> uv_;
  Array<const uint8_t, nb::ndim<1>> used_;
  Picture albedo_;
  Plane trust_;
  mien::AlignOptions options_;
  int64_t vertices_ = 0;
};

mien::AlignFrame frame_of(const Points& vertices, const Points& normals, const Matrix3& K, const Matrix4& viewmat,
                          const Picture& image, const Plane& mask, const Light& light) {
  if (normals.shape(0) != vertices.shape(0)) throw nb::value_error("normals must have a row a vertex");
  if (mask.shape(0) != image.shape(0) || mask.shape(1) != image.shape(1)) {
    throw nb::value_error("image and mask must be of one picture");
  }
  return {{K.data(), viewmat.data(), static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0))},
          normals.data(),
          image.data(),
          mask.data(),
          light.data()};
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
  if (derive != hessian.has_value() || derive != gradient.has_value()) {
    throw nb::value_error("jacobian, hessian and gradient go together");
  }
  if (derive && (jacobian->shape(0) != vertices.shape(0) || hessian->shape(0) != jacobian->shape(2) ||
                 hessian->shape(1) != jacobian->shape(2) || gradient->shape(0) != jacobian->shape(2))) {
    throw nb::value_error("jacobian, hessian and gradient must agree on vertices and parameters");
  }
  if ((residual && residual->size() != image.size()) || (smooth && smooth->size() != image.size())) {
    throw nb::value_error("residual and smooth must be of the picture's size");
  }
  const mien::Mesh mesh = surface.mesh(vertices);
  const mien::AlignFrame frame = frame_of(vertices, normals, K, viewmat, image, mask, light);
  const mien::AlignBuffers out{derive ? hessian->data() : nullptr, derive ? gradient->data() : nullptr,
                               residual ? residual->data() : nullptr, smooth ? smooth->data() : nullptr};
  const nb::gil_scoped_release release;
  const mien::AlignResult result =
      mien::align_mesh(mesh, surface.surface(), frame, surface.options(), {high_pass},
                       derive ? jacobian->data() : nullptr, derive ? static_cast<int>(jacobian->shape(2)) : 0, out);
  return {result.cost, result.weight};
}

void bake_texture(const AlignSurface& surface, const Points& vertices, const Points& normals, const Matrix3& K,
                  const Matrix4& viewmat, const Picture& image, const Plane& mask, const Light& light,
                  const Array<const int32_t, nb::ndim<2>>& texel_face, const Picture& texel_barycentric,
                  const Array<float, nb::ndim<2>>& weight, const Array<float, nb::ndim<3>>& squares,
                  const Array<float, nb::ndim<3>>& mixed, const Array<float, nb::ndim<3>>& image_squares) {
  const mien::TexturedSurface textured = surface.surface();
  const size_t count = static_cast<size_t>(textured.texture_width) * textured.texture_height;
  const mien::Mesh mesh = surface.mesh(vertices);
  if (texel_face.size() != count || texel_barycentric.size() != 3 * count || weight.size() != count ||
      squares.size() != 3 * count || mixed.size() != 3 * count || image_squares.size() != 3 * count) {
    throw nb::value_error("texels and sums must be of the texture's size");
  }
  const mien::AlignFrame frame = frame_of(vertices, normals, K, viewmat, image, mask, light);
  const nb::gil_scoped_release release;
  if (count > 0 && *std::max_element(texel_face.data(), texel_face.data() + count) >= mesh.face_count) {
    throw std::out_of_range("the texels name a triangle that does not exist");
  }
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
      .def(nb::init<Faces, Array<const float, nb::shape<-1, 3, 2>>, Array<const uint8_t, nb::ndim<1>>, Picture, Plane,
                    float, float, float>(),
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
