#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <vector>

#include "arrays.h"
#include "factored_terms.h"
#include "feature_network.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

struct NetworkArrays {
  static constexpr char kName[] = "FeatureNetwork";
  static constexpr const char* kFields[] = {"neutral", "own", "weight1", "bias1", "weight2", "bias2"};
  In<-1, -1> neutral, own, weight1;
  In<-1> bias1;
  In<-1, -1> weight2;
  In<-1> bias2;

  explicit NetworkArrays(const Group<NetworkArrays>& group) {
    group.read(neutral, own, weight1, bias1, weight2, bias2);
    const size_t features = neutral.shape(1), hidden = bias1.shape(0), width = bias2.shape(0);
    require(features >= 1 && hidden >= 1 && width >= 1, "features, hidden values and outputs must not be empty");
    for (const size_t length : {features, own.shape(1), hidden, width})
      checked_length(length, kMostWidth, "numbers in a row");
    require(own.shape(0) == neutral.shape(0), "every array must have one row per Gaussian");
    require(has_shape(weight1, hidden, features + own.shape(1)) && has_shape(weight2, width, hidden),
            "the layers do not fit each other");
  }
  size_t count() const { return neutral.shape(0); }
  size_t features() const { return neutral.shape(1); }
  mien::FeatureNetwork network() const {
    return {static_cast<int64_t>(count()),
            static_cast<int>(features()),
            static_cast<int>(own.shape(1)),
            static_cast<int>(bias1.shape(0)),
            static_cast<int>(bias2.shape(0)),
            neutral.data(),
            own.data(),
            weight1.data(),
            bias1.data(),
            weight2.data(),
            bias2.data()};
  }
};

struct BasesArrays {
  static constexpr char kName[] = "FeatureBases";
  static constexpr const char* kFields[] = {"values", "inputs", "rows"};
  In<-1, -1, -1> values;
  In<-1, -1> inputs;
  std::optional<Rows> rows;

  explicit BasesArrays(const Group<BasesArrays>& group) { group.read(values, inputs, rows); }

  mien::FeatureInputs of(const NetworkArrays& own) const {
    const int k = checked_length(inputs.shape(1), kMostWidth, "inputs");
    require(has_shape(values, own.count(), k, own.features()),
            "bases must have one row per Gaussian and input, as long as its features");
    return {values.data(), k, inputs.data(), checked_rows(rows, own.count(), inputs.shape(0))};
  }
};

struct KeptArrays {
  static constexpr char kName[] = "FeatureKept";
  static constexpr const char* kFields[] = {"features", "hidden"};
  Out<-1, -1> features, hidden;

  KeptArrays(const Group<KeptArrays>& group, const mien::FeatureNetwork& network) {
    group.read(features, hidden);
    require(has_shape(features, network.count, network.features) &&
                has_shape(hidden, network.count, mien::hidden_stride(network.hidden)),
            "what is kept must have one row per Gaussian");
  }
};

struct GradientArrays {
  static constexpr char kName[] = "FeatureGradients";
  static constexpr const char* kFields[] = {"outputs", "last",  "features", "weight1", "bias1",
                                            "weight2", "bias2", "inputs",   "owns"};
  In<-1, -1> outputs;
  In<-1> last;
  Out<-1, -1> features, weight1;
  Out<-1> bias1;
  Out<-1, -1> weight2;
  Out<-1> bias2, inputs;
  Out<-1, -1> owns;

  GradientArrays(const Group<GradientArrays>& group, const NetworkArrays& own, const mien::FeatureInputs& in) {
    group.read(outputs, last, features, weight1, bias1, weight2, bias2, inputs, owns);
    require(has_shape(outputs, own.count(), own.bias2.shape(0) - 1) && has_shape(last, own.count()),
            "outputs must have one row per Gaussian");
    require(same_shape(features, own.neutral) && same_shape(weight1, own.weight1) && same_shape(bias1, own.bias1) &&
                same_shape(weight2, own.weight2) && same_shape(bias2, own.bias2) &&
                (inputs.shape(0) == 0 || (has_shape(inputs, in.count) && !in.rows)) &&
                (owns.shape(0) == 0 || same_shape(owns, own.own)),
            "a gradient must have the shape of its array");
  }
};

void feature_network(const Group<NetworkArrays>& group, const Group<BasesArrays>& bases,
                     const std::optional<Group<KeptArrays>>& keep, const Out<-1, -1>& outputs, const Out<-1>& last) {
  const NetworkArrays own(group);
  const BasesArrays arrays(bases);
  const mien::FeatureInputs inputs = arrays.of(own);
  const mien::FeatureNetwork network = own.network();
  require(has_shape(outputs, own.count(), network.width - 1) && has_shape(last, own.count()),
          "outputs must have one row per Gaussian");
  std::optional<KeptArrays> kept;
  if (keep) kept.emplace(*keep, network);
  const nb::gil_scoped_release release;
  mien::feature_network(network, inputs,
                        kept ? mien::FeatureKept{kept->features.data(), kept->hidden.data()} : mien::FeatureKept{},
                        outputs.data(), last.data());
}

void feature_network_backward(const Group<NetworkArrays>& group, const Group<BasesArrays>& bases,
                              const Group<KeptArrays>& keep, const Group<GradientArrays>& gradients) {
  const NetworkArrays own(group);
  const BasesArrays arrays(bases);
  const mien::FeatureInputs inputs = arrays.of(own);
  const mien::FeatureNetwork network = own.network();
  const KeptArrays kept(keep, network);
  const GradientArrays out(gradients, own, inputs);
  const nb::gil_scoped_release release;
  mien::feature_network_backward(
      network, inputs, {kept.features.data(), kept.hidden.data()},
      {out.outputs.data(), out.last.data(), out.features.data(), out.weight1.data(), out.bias1.data(),
       out.weight2.data(), out.bias2.data(), out.inputs.shape(0) == 0 ? nullptr : out.inputs.data(),
       out.owns.shape(0) == 0 ? nullptr : out.owns.data()});
}

void factored_update(const Out<-1, -1, -1>& values, const std::vector<In<-1, -1>>& rows,
                     const std::vector<In<-1, -1>>& columns, const std::vector<std::optional<Rows>>& places,
                     const Out<-1, -1>& second, const Out<-1>& weights, float rate) {
  const size_t count = values.shape(0), width = values.shape(2);
  require(has_shape(second, count, width) && has_shape(weights, count), "moments must fit the values");
  const FactoredTerms gradient(values, rows, columns, places);
  const nb::gil_scoped_release release;
  mien::factored_update({values.data(), static_cast<int64_t>(count), gradient.columns_count, gradient.width,
                         gradient.terms.data(), static_cast<int>(gradient.terms.size()), second.data(), weights.data(),
                         rate});
}

}  // namespace

void bind_feature_network(nb::module_& module) {
  bind_group<NetworkArrays>(module);
  bind_group<BasesArrays>(module);
  bind_group<KeptArrays>(module);
  bind_group<GradientArrays>(module);
  module.def("feature_network", &feature_network, "network"_a, "bases"_a, "kept"_a.none(), "outputs"_a.noconvert(),
             "last"_a.noconvert(), "Fills the network's outputs, the last of each Gaussian apart.");
  module.def("feature_network_backward", &feature_network_backward, "network"_a, "bases"_a, "kept"_a, "gradients"_a,
             "Fills the gradients of features, layers and inputs.");
  module.def("factored_update", &factored_update, "values"_a.noconvert(), "rows"_a, "columns"_a, "places"_a, "second"_a,
             "weights"_a, "rate"_a,
             "Updates values [n, k, f] by a gradient that is a sum of outer products, in place.");
}
