#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <cmath>
#include <optional>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "factored_terms.h"
#include "surface_limits.h"
#include "training.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Floats = Array<float, nb::ndim<1>>;
using Rows3 = Array<const float, nb::shape<-1, 3>>;
constexpr double kBeta1 = 0.9, kBeta2 = 0.999;  // for bias correction; the same numbers as in Python
using Radii = Array<const int32_t, nb::ndim<1>>;

struct Corrections {
  float step_size, second_unbiased;
};

// Adam's corrections of its running means at the next step, which is counted and averages `frames`.
Corrections next_corrections(const Array<float, nb::shape<>>& steps, double rate, int frames = 1) {
  const double count = frames * static_cast<double>(*steps.data() += 1);
  return {static_cast<float>(rate / (1 - std::pow(kBeta1, count))),
          static_cast<float>(1 / std::sqrt(1 - std::pow(kBeta2, count)))};
}

// One tensor's arrays, which stay alive while this does.
struct AdamArrays {
  static constexpr char kName[] = "AdamTask";
  static constexpr const char* kFields[] = {"values", "gradient", "first", "second", "steps", "rate", "frames"};
  Array<float> values;
  Array<const float> gradient;
  Array<float> first, second;
  Array<float, nb::shape<>> steps;
  double rate = 0;
  int frames = 1;

  explicit AdamArrays(const Group<AdamArrays>& group) {
    group.read(values, gradient, first, second, steps, rate, frames);
    require(same_shape(gradient, values) && same_shape(first, values) && same_shape(second, values),
            "gradient and moments must have the shape of the values");
    require(frames > 0, "a step must average at least one frame");
  }
  mien::AdamTask step() const {
    const Corrections found = next_corrections(steps, rate, frames);
    const mien::AdamDecays decays{static_cast<float>(std::pow(kBeta1, frames)),
                                  static_cast<float>(std::pow(kBeta2, frames))};
    return {values.data(),   gradient.data(),       first.data(), second.data(), static_cast<int64_t>(values.size()),
            found.step_size, found.second_unbiased, decays};
  }
};

void factored_adam_update(const Out<-1, -1, -1>& values, const std::vector<In<-1, -1>>& rows,
                          const std::vector<In<-1, -1>>& columns, const std::vector<std::optional<Rows>>& places,
                          const Out<-1, -1, -1>& first, const Out<-1, -1, -1>& second,
                          const Array<float, nb::shape<>>& steps, double rate) {
  require(same_shape(first, values) && same_shape(second, values), "moments must have the shape of the values");
  const FactoredTerms gradient(values, rows, columns, places);
  const Corrections found = next_corrections(steps, rate);
  const nb::gil_scoped_release release;
  mien::factored_adam_update({values.data(), gradient.terms.data(), first.data(), second.data(),
                              static_cast<int64_t>(values.shape(0)), gradient.columns_count, gradient.width,
                              static_cast<int>(gradient.terms.size()), found.step_size, found.second_unbiased});
}

void adam_update(const std::vector<Group<AdamArrays>>& groups) {
  const std::vector<AdamArrays> arrays(groups.begin(), groups.end());
  std::vector<mien::AdamTask> tasks;
  tasks.reserve(arrays.size());
  for (const AdamArrays& own : arrays) tasks.push_back(own.step());
  const nb::gil_scoped_release release;
  mien::adam_update(tasks.data(), static_cast<int>(tasks.size()));
}

void add_arrays(const std::vector<Array<const float>>& first, const std::vector<Array<const float>>& second,
                const std::vector<Array<float>>& sums) {
  require(second.size() == first.size() && sums.size() == first.size(), "there must be as many arrays of each kind");
  std::vector<mien::SumTask> tasks;
  tasks.reserve(sums.size());
  for (size_t i = 0; i < sums.size(); ++i) {
    require(same_shape(first[i], sums[i]) && same_shape(second[i], sums[i]), "arrays must have the shape of their sum");
    tasks.push_back({first[i].data(), second[i].data(), sums[i].data(), static_cast<int64_t>(sums[i].size())});
  }
  const nb::gil_scoped_release release;
  mien::add_arrays(tasks.data(), static_cast<int>(tasks.size()));
}

void triangle_penalties(const std::array<float, 2>& thresholds, const std::array<float, 2>& weights, const Rows3& means,
                        const Rows3& log_scales, const Radii& radii, const Array<float, nb::shape<-1, 3>>& grad_means,
                        const Array<float, nb::shape<-1, 3>>& grad_log_scales,
                        const Array<float, nb::shape<>>& position, const Array<float, nb::shape<>>& scale) {
  const size_t n = means.shape(0);
  require(log_scales.shape(0) == n && radii.shape(0) == n && grad_means.shape(0) == n && grad_log_scales.shape(0) == n,
          "every array must have one row per Gaussian");
  const mien::PenaltyTask task{
      static_cast<int64_t>(n), means.data(), log_scales.data(), radii.data(),          thresholds[0], weights[0],
      thresholds[1],           weights[1],   grad_means.data(), grad_log_scales.data()};
  const nb::gil_scoped_release release;
  const mien::Penalties sums = mien::triangle_penalties(task);
  *position.data() = static_cast<float>(sums.position);
  *scale.data() = static_cast<float>(sums.scale);
}

void observe_view(const std::array<float, 2>& scale, const Array<const float, nb::shape<-1, 2>>& grad_means2d,
                  const Radii& radii, const Array<const float, nb::ndim<1>>& opacities, const Floats& pull,
                  const Floats& seen, const Array<int32_t, nb::ndim<1>>& radius, const Floats& opacity) {
  const size_t n = radii.shape(0);
  require(grad_means2d.shape(0) == n && opacities.shape(0) == n && pull.shape(0) == n && seen.shape(0) == n &&
              radius.shape(0) == n && opacity.shape(0) == n,
          "every array must have one entry per Gaussian");
  const nb::gil_scoped_release release;
  mien::observe_view({static_cast<int64_t>(n), grad_means2d.data(), radii.data(), opacities.data(), scale[0], scale[1],
                      pull.data(), seen.data(), radius.data(), opacity.data()});
}

using Rows = Array<float, nb::shape<-1, 3>>;

void keep_on_surface(const Array<const int64_t, nb::ndim<1>>& triangle,
                     const Array<const float, nb::shape<-1, 5>>& limits, float ratio, const Rows& means,
                     const Array<float, nb::shape<-1, 4>>& quats, const Rows& log_scales,
                     const std::optional<Array<const float, nb::shape<-1, 4>>>& pulls, const Rows& colors) {
  const size_t n = triangle.shape(0);
  require(means.shape(0) == n && quats.shape(0) == n && log_scales.shape(0) == n && colors.shape(0) == n,
          "every array must have one row per Gaussian");
  require(!pulls || pulls->shape(0) == limits.shape(0), "limits and pulls must have one row per triangle");
  const nb::gil_scoped_release release;
  check_indices(triangle, static_cast<int64_t>(limits.shape(0)), "a triangle lies outside the limits");
  mien::keep_on_surface({static_cast<int64_t>(n), triangle.data(), limits.data(), ratio, means.data(), quats.data(),
                         log_scales.data(), pulls ? pulls->data() : nullptr, colors.data()});
}

void clear_rows(const Array<const uint8_t, nb::ndim<1>>& chosen, const std::vector<Array<float>>& arrays) {
  const size_t n = chosen.shape(0);
  for (const Array<float>& own : arrays) {
    require(own.ndim() >= 1 && own.shape(0) == n, "every array must have one row per Gaussian");
  }
  const nb::gil_scoped_release release;
  for (const Array<float>& own : arrays) {
    const int64_t width = n == 0 ? 0 : static_cast<int64_t>(own.size() / n);
    mien::clear_rows(chosen.data(), static_cast<int64_t>(n), width, own.data());
  }
}

std::tuple<int, int, int, int> box_of_nonzero(const Array<const float, nb::ndim<2>>& values) {
  const nb::gil_scoped_release release;
  const auto [width, height] = picture_size(values);
  const mien::PixelBox box = mien::box_of_nonzero(values.data(), width, height);
  return {box.left, box.top, box.right - box.left, box.bottom - box.top};
}

double mean_squared_difference(const Array<const float>& image, const Array<const uint8_t>& target) {
  require(same_shape(image, target), "the pictures must be equally large");
  const nb::gil_scoped_release release;
  return mien::mean_squared_difference(image.data(), target.data(), static_cast<int64_t>(image.size()));
}

void absolute_difference(const Array<const float, nb::ndim<2>>& values, const Array<const uint8_t, nb::ndim<2>>& target,
                         float weight, const Array<float, nb::ndim<2>>& gradient,
                         const Array<float, nb::shape<>>& loss) {
  require(same_shape(values, target) && same_shape(values, gradient), "the pictures must be equally large");
  const nb::gil_scoped_release release;
  *loss.data() = static_cast<float>(mien::absolute_difference(
      values.data(), target.data(), static_cast<int64_t>(values.size()), weight, gradient.data()));
}

void color_difference(const Array<const float, nb::shape<-1, -1, 3>>& image,
                      const Array<const uint8_t, nb::shape<-1, -1, 3>>& target,
                      const std::optional<Array<const uint8_t, nb::ndim<2>>>& counted, float weight, float free,
                      const Array<float, nb::shape<-1, -1, 3>>& gradient, const Array<float, nb::shape<>>& loss) {
  require(same_shape(image, target) && same_shape(image, gradient), "the pictures must be equally large");
  require(!counted || has_shape(*counted, image.shape(0), image.shape(1)), "`counted` must have the picture's pixels");
  const nb::gil_scoped_release release;
  *loss.data() = static_cast<float>(
      mien::color_difference({image.data(), target.data(), counted ? counted->data() : nullptr,
                              static_cast<int64_t>(image.size() / 3), weight, free, gradient.data()}));
}

}  // namespace

void bind_training(nb::module_& module) {
  bind_group<AdamArrays>(module);
  module.def("factored_adam_update", &factored_adam_update, "values"_a.noconvert(), "rows"_a, "columns"_a, "places"_a,
             "first"_a.noconvert(), "second"_a.noconvert(), "steps"_a.noconvert(), "rate"_a,
             "Makes one step of Adam with values [n, k, f], whose gradient is a sum of outer products.");
  module.def("adam_update", &adam_update, "tasks"_a,
             "Makes one step of Adam with every tensor. The number of steps grows by one.");
  module.def("add_arrays", &add_arrays, "first"_a, "second"_a, "sums"_a, "Fills the sums of two arrays each.");
  module.def("triangle_penalties", &triangle_penalties, "thresholds"_a, "weights"_a, "means"_a, "log_scales"_a,
             "radii"_a, "grad_means"_a, "grad_log_scales"_a, "position"_a, "scale"_a,
             "Fills the position and the scale penalty, and their gradients.");
  module.def("observe_view", &observe_view, "scale"_a, "grad_means2d"_a, "radii"_a, "opacities"_a, "pull"_a, "seen"_a,
             "radius"_a, "opacity"_a, "Adds a step to the statistics of density control.");
  module.def("keep_on_surface", &keep_on_surface, "triangle"_a, "limits"_a, "ratio"_a, "means"_a, "quats"_a,
             "log_scales"_a, "pulls"_a.none(), "colors"_a, "Brings Gaussians back to their limits, in place.");
  module.def("clear_rows", &clear_rows, "chosen"_a, "arrays"_a, "Sets the chosen rows of all arrays to 0, in place.");
  module.def("mean_squared_difference", &mean_squared_difference, "image"_a.noconvert(), "target"_a.noconvert(),
             "The mean squared difference of a picture and one of bytes, where 255 is 1.");
  module.def("absolute_difference", &absolute_difference, "values"_a, "target"_a, "weight"_a, "gradient"_a, "loss"_a,
             "Fills the weighted mean absolute difference of a picture and one of bytes, where 255 is 1, and its "
             "gradient.");
  module.def("color_difference", &color_difference, "image"_a, "target"_a, "counted"_a.none(), "weight"_a, "free"_a,
             "gradient"_a, "loss"_a,
             "The same of colours: differences up to `free` cost nothing, and pixels that are not counted add 0.");
  module.def("box_of_nonzero", &box_of_nonzero, "values"_a.noconvert(),
             "Left, top, width and height of the box that holds all numbers other than 0.");
}
