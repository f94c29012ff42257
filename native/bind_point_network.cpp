#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <vector>

#include "arrays.h"
#include "point_network.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

constexpr int64_t kMostWidth = 1 << 20;  // so that products of widths fit

struct LayerArrays {
  static constexpr char kName[] = "PointLayer";
  static constexpr const char* kFields[] = {"weight", "bias", "activation", "extra"};
  In<-1, -1> weight;
  In<-1> bias;
  int activation = 0, extra = -1;

  explicit LayerArrays(const Group<LayerArrays>& group) { group.read(weight, bias, activation, extra); }
};

struct LayerGradientArrays {
  static constexpr char kName[] = "PointLayerGradients";
  static constexpr const char* kFields[] = {"weight", "bias"};
  Out<-1, -1> weight;
  Out<-1> bias;

  explicit LayerGradientArrays(const Group<LayerGradientArrays>& group) { group.read(weight, bias); }
};

using Layers = std::vector<Group<LayerArrays>>;

// A network whose arrays stay alive with it.
struct Network {
  std::vector<LayerArrays> arrays;
  std::vector<mien::PointLayer> items;
  mien::PointNetwork own{};

  Network(const Layers& layers, const In<-1, -1>& inputs) : arrays(layers.begin(), layers.end()) {
    require(!arrays.empty() && arrays.size() <= mien::kMostPointLayers, "there must be 1 to 64 layers");
    std::vector<size_t> widths{inputs.shape(1)};
    for (size_t l = 0; l < arrays.size(); ++l) {
      const LayerArrays& layer = arrays[l];
      const bool last = l + 1 == arrays.size();
      require(layer.activation >= 0 && layer.activation <= (last ? 0 : 2),
              "an activation must be 0, 1 or 2, and 0 in the last layer");
      require(layer.extra >= -1 && layer.extra < static_cast<int>(l), "extra values must be of an earlier layer");
      const size_t extra = layer.extra < 0 ? 0 : widths[layer.extra];
      require(widths.back() >= 1 && has_shape(layer.weight, layer.bias.shape(0), widths.back() + extra),
              "the layers do not fit each other");
      const int outputs = checked_length(layer.bias.shape(0), kMostWidth, "numbers in a row");
      widths.push_back(layer.bias.shape(0));
      items.push_back({layer.weight.data(), layer.bias.data(), outputs,
                       static_cast<mien::PointActivation>(layer.activation), layer.extra});
    }
    require(widths.back() >= 1, "the layers do not fit each other");
    own = {static_cast<int64_t>(inputs.shape(0)), checked_length(widths[0], kMostWidth, "numbers in a row"),
           inputs.data(), static_cast<int>(items.size()), items.data()};
  }
  int outputs() const { return items.back().outputs; }
};

void check_kept(const Out<-1, -1>& kept, const mien::PointNetwork& network) {
  require(has_shape(kept, network.count, mien::point_kept_floats(network)), "what is kept must have one row per point");
}

void point_network(const Layers& layers, const In<-1, -1>& inputs, const std::optional<Out<-1, -1>>& kept,
                   const Out<-1, -1>& outputs) {
  const Network network(layers, inputs);
  require(has_shape(outputs, network.own.count, network.outputs()), "outputs must have one row per point");
  if (kept) check_kept(*kept, network.own);
  const nb::gil_scoped_release release;
  mien::point_network(network.own, kept ? kept->data() : nullptr, outputs.data());
}

void point_network_backward(const Layers& layers, const In<-1, -1>& inputs, const Out<-1, -1>& kept,
                            const In<-1, -1>& by_outputs, const std::vector<Group<LayerGradientArrays>>& gradients,
                            const std::optional<Out<-1, -1>>& by_inputs) {
  const Network network(layers, inputs);
  check_kept(kept, network.own);
  require(has_shape(by_outputs, network.own.count, network.outputs()), "outputs must have one row per point");
  require(!by_inputs || same_shape(*by_inputs, inputs), "a gradient must have the shape of its array");
  const std::vector<LayerGradientArrays> arrays(gradients.begin(), gradients.end());
  require(arrays.size() == network.items.size(), "every layer must have gradients");
  std::vector<mien::PointLayerGradients> into;
  for (size_t l = 0; l < arrays.size(); ++l) {
    require(
        same_shape(arrays[l].weight, network.arrays[l].weight) && same_shape(arrays[l].bias, network.arrays[l].bias),
        "a gradient must have the shape of its array");
    into.push_back({arrays[l].weight.data(), arrays[l].bias.data()});
  }
  const nb::gil_scoped_release release;
  mien::point_network_backward(network.own, kept.data(),
                               {by_outputs.data(), into.data(), by_inputs ? by_inputs->data() : nullptr});
}

}  // namespace

void bind_point_network(nb::module_& module) {
  bind_group<LayerArrays>(module);
  bind_group<LayerGradientArrays>(module);
  module.def("point_network", &point_network, "layers"_a, "inputs"_a, "kept"_a.none(), "outputs"_a.noconvert(),
             "Fills the outputs of a network of layers, and what the backward pass needs.");
  module.def("point_network_backward", &point_network_backward, "layers"_a, "inputs"_a, "kept"_a.noconvert(),
             "by_outputs"_a, "gradients"_a, "by_inputs"_a.none(), "Fills the gradients of layers and inputs.");
}
