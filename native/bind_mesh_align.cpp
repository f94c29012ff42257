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

// The surface, which is the same in all frames of a sequence and is checked once.
class AlignSurface {
 public:
  AlignSurface(const Faces& faces, In<-1, 3, 2> uv, Array<const uint8_t, nb::ndim<1>> used, Picture albedo, Plane trust,
               float sigma, float outlier, float least_cosine)
      : faces_(faces.data(), faces.data() + faces.size()),
        uv_(std::move(uv)),
        used_(std::move(used)),
        albedo_(std::move(albedo)),
        trust_(std::move(trust)),
        options_{sigma, outlier, least_cosine} {
    const int face_count = checked_length(faces.shape(0), "triangles");
    require(uv_.shape(0) == faces.shape(0) && used_.shape(0) == faces.shape(0),
            "uv and used must have one row per face");
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
  std::vector<int64_t> faces_;  // a copy: Python cannot change it after the check
  In<-1, 3, 2> uv_;
  Array<const uint8_t, nb::ndim<1>> used_;
  Picture albedo_;
  Plane trust_;
  mien::AlignOptions options_;
  mien::TexturedSurface surface_;
  int64_t vertices_ = 0;  // number of vertices that the faces need
};

// A posed surface in a picture under a light.
struct Sighting {
  static constexpr char kName[] = "SightingArrays";
  static constexpr const char* kFields[] = {"vertices", "normals", "K", "viewmat", "image", "mask", "light"};
  Points vertices, normals;
  In<3, 3> K;
  In<4, 4> viewmat;
  Picture image;
  Plane mask;
  In<9, 3> light;
  PictureSize size;

  explicit Sighting(const Group<Sighting>& group) {
    group.read(vertices, normals, K, viewmat, image, mask, light);
    size = picture_size(image);
    require(normals.shape(0) == vertices.shape(0), "normals must have one row per vertex");
    require(has_shape(mask, size.height, size.width), "image and mask must be of one picture");
  }
  mien::AlignFrame frame() const {
    return {
        {K.data(), viewmat.data(), size.width, size.height}, normals.data(), image.data(), mask.data(), light.data()};
  }
};

// The Jacobian of the vertices, and the normal equations to be filled.
struct Derivatives {
  static constexpr char kName[] = "AlignDerivatives";
  static constexpr const char* kFields[] = {"jacobian", "hessian", "gradient"};
  In<-1, 3, -1> jacobian;
  Out<-1, -1> hessian;
  Out<-1> gradient;
  int parameters;

  Derivatives(const Group<Derivatives>& group, const Points& vertices) {
    group.read(jacobian, hessian, gradient);
    parameters = checked_length(jacobian.shape(2), "parameters");
    require(jacobian.shape(0) == vertices.shape(0) && has_shape(hessian, parameters, parameters) &&
                has_shape(gradient, parameters),
            "jacobian, hessian and gradient must agree on vertices and parameters");
  }
};

std::pair<double, double> align_mesh(const AlignSurface& surface, const Group<Sighting>& sighting_group, int high_pass,
                                     const std::optional<Group<Derivatives>>& derivative_group,
                                     const std::optional<Out<-1, -1, 3>>& residual,
                                     const std::optional<Out<-1, -1, 3>>& smooth) {
  const Sighting sighting(sighting_group);
  std::optional<Derivatives> derivatives;
  if (derivative_group) derivatives.emplace(*derivative_group, sighting.vertices);
  require((!residual || same_shape(*residual, sighting.image)) && (!smooth || same_shape(*smooth, sighting.image)),
          "residual and smooth must be of the picture's size");
  require(high_pass >= 0, "high_pass must be a number of pixels, or 0");
  const mien::Mesh mesh = surface.mesh(sighting.vertices);
  const mien::AlignBuffers out{derivatives ? derivatives->hessian.data() : nullptr,
                               derivatives ? derivatives->gradient.data() : nullptr,
                               residual ? residual->data() : nullptr, smooth ? smooth->data() : nullptr};
  const nb::gil_scoped_release release;
  const mien::AlignResult result = mien::align_mesh(mesh, surface.surface(), sighting.frame(), surface.options(),
                                                    {high_pass}, derivatives ? derivatives->jacobian.data() : nullptr,
                                                    derivatives ? derivatives->parameters : 0, out);
  return {result.cost, result.weight};
}

// Sums over sightings, for each texel.
struct TextureSums {
  static constexpr char kName[] = "TextureSums";
  static constexpr const char* kFields[] = {"weight", "squares", "mixed", "image_squares"};
  Out<-1, -1> weight;
  Out<-1, -1, 3> squares, mixed, image_squares;

  TextureSums(const Group<TextureSums>& group, int rows, int columns) {
    group.read(weight, squares, mixed, image_squares);
    require(has_shape(weight, rows, columns) && has_shape(squares, rows, columns, 3) && same_shape(mixed, squares) &&
                same_shape(image_squares, squares),
            "sums must be of the texture's size");
  }
};

void bake_texture(const AlignSurface& surface, const Group<Sighting>& sighting_group,
                  const Array<const int32_t, nb::ndim<2>>& texel_face, const Picture& texel_barycentric,
                  const Group<TextureSums>& sum_group) {
  const mien::TexturedSurface& textured = surface.surface();
  const int rows = textured.texture_height, columns = textured.texture_width;
  const Sighting sighting(sighting_group);
  const TextureSums sums(sum_group, rows, columns);
  const mien::Mesh mesh = surface.mesh(sighting.vertices);
  require(has_shape(texel_face, rows, columns) && has_shape(texel_barycentric, rows, columns, 3),
          "texels must be of the texture's size");
  const nb::gil_scoped_release release;
  check_indices(texel_face, mesh.face_count, "the texels name a triangle that does not exist", -1);
  mien::bake_texture(mesh, textured, sighting.frame(), surface.options(), {texel_face.data(), texel_barycentric.data()},
                     {sums.weight.data(), sums.squares.data(), sums.mixed.data(), sums.image_squares.data()});
}

void light_equations(const AlignSurface& surface, const Group<Sighting>& sighting_group,
                     const Array<double, nb::shape<3, 9, 9>>& hessian, const Array<double, nb::shape<3, 9>>& right) {
  const Sighting sighting(sighting_group);
  const mien::Mesh mesh = surface.mesh(sighting.vertices);
  const nb::gil_scoped_release release;
  mien::light_equations(mesh, surface.surface(), sighting.frame(), surface.options(), hessian.data(), right.data());
}

}  // namespace

void bind_mesh_align(nb::module_& module) {
  bind_group<Sighting>(module);
  bind_group<Derivatives>(module);
  bind_group<TextureSums>(module);
  nb::class_<AlignSurface>(module, "AlignSurface")
      .def(nb::init<const Faces&, In<-1, 3, 2>, Array<const uint8_t, nb::ndim<1>>, Picture, Plane, float, float,
                    float>(),
           "faces"_a, "uv"_a, "used"_a, "albedo"_a, "trust"_a, "sigma"_a, "outlier"_a, "least_cosine"_a);
  module.def("align_mesh", &align_mesh, "surface"_a, "sighting"_a, "high_pass"_a, "derivatives"_a.none(),
             "residual"_a.none(), "smooth"_a.none());
  module.def("bake_texture", &bake_texture, "surface"_a, "sighting"_a, "texel_face"_a, "texel_barycentric"_a, "sums"_a);
  module.def("light_equations", &light_equations, "surface"_a, "sighting"_a, "hessian"_a, "right"_a);
}
