// Poses a face and the Gaussians bound to its triangles for a training step, with their changes, in one call each way
// and for one timestep. face.h, rig.h, bound_changes.h and activation.h do the work.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>

#include "activation.h"
#include "arrays.h"
#include "bound_changes.h"
#include "change_arrays.h"
#include "face.h"
#include "face_arrays.h"
#include "memory.h"
#include "rig.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// The changed Gaussians in the frames of their triangles, and what the network keeps of its features.
struct KeptChanges {
  mien::Recycled<float> means, opacity_logits;
  std::optional<mien::Recycled<float>> features, hidden;

  KeptChanges(size_t count, const mien::FeatureNetwork* network) : means(3 * count), opacity_logits(count) {
    if (!network) return;
    features.emplace(count * static_cast<size_t>(network->features));
    hidden.emplace(count * static_cast<size_t>(mien::hidden_stride(network->hidden)));
  }
  bool fits(size_t count, const mien::FeatureNetwork* network) const {
    return means.size() == 3 * count && features.has_value() == (network != nullptr) &&
           (!network || (features->size() == count * static_cast<size_t>(network->features) &&
                         hidden->size() == count * static_cast<size_t>(mien::hidden_stride(network->hidden))));
  }
  mien::FeatureKept kept() const {
    return features ? mien::FeatureKept{features->data(), hidden->data()} : mien::FeatureKept{};
  }
};

// What the backward pass needs of its forward pass.
struct Ride {
  // The addresses of its model and topology. They are compared and never read, since both may be gone. Another model at
  // the same address is accepted only if it has the same sizes.
  const void *model, *topology;
  bool in_head;
  int vertex_count;
  size_t face_count;
  mien::Recycled<float> shaped, vertices;
  mien::Recycled<mien::TriangleFrame> frames;
  std::optional<KeptChanges> changes;

  Ride(const mien::FaceModelData& model, const mien::RigTopology& topology, bool in_head)
      : model(&model),
        topology(&topology),
        in_head(in_head),
        vertex_count(model.vertices),
        face_count(topology.faces.size() / 3),
        shaped(3 * static_cast<size_t>(vertex_count)),
        vertices(3 * static_cast<size_t>(vertex_count)),
        frames(face_count) {}
  bool is_of(const mien::FaceModelData& other, const mien::RigTopology& others) const {
    return model == &other && topology == &others && vertex_count == other.vertices &&
           face_count == others.faces.size() / 3;
  }
};

// Gaussians in units of their triangles: values, or gradients of them.
template <typename T>
struct LocalGaussians {
  static constexpr char kName[] = "LocalGaussians";
  static constexpr const char* kFields[] = {"means", "quats", "log_scales", "opacity_logits"};
  Array<T, nb::shape<-1, 3>> means;
  Array<T, nb::shape<-1, 4>> quats;
  Array<T, nb::shape<-1, 3>> log_scales;
  Array<T, nb::shape<-1>> opacity_logits;

  LocalGaussians(const Group<LocalGaussians>& group, size_t count) {
    group.read(means, quats, log_scales, opacity_logits);
    require(means.shape(0) == count && quats.shape(0) == count && log_scales.shape(0) == count &&
                opacity_logits.shape(0) == count,
            "parameters and their gradients must have one row per Gaussian");
  }
};

// The same in world space or in the head frame, and that frame's pose, which may be missing.
template <typename T>
struct PosedGaussians {
  static constexpr char kName[] = "PosedGaussians";
  static constexpr const char* kFields[] = {"means", "quats", "scales", "opacities", "head_pose"};
  Array<T, nb::shape<-1, 3>> means;
  Array<T, nb::shape<-1, 4>> quats;
  Array<T, nb::shape<-1, 3>> scales;
  Array<T, nb::shape<-1>> opacities;
  std::optional<Array<T, nb::shape<4, 4>>> head_pose;

  PosedGaussians(const Group<PosedGaussians>& group, size_t count) {
    group.read(means, quats, scales, opacities, head_pose);
    require(
        means.shape(0) == count && quats.shape(0) == count && scales.shape(0) == count && opacities.shape(0) == count,
        "posed Gaussians and their gradients must have one row per Gaussian");
  }
};

// Gradients of the face parameters.
struct FaceParameterGradients {
  static constexpr char kName[] = "FaceParameterGradients";
  static constexpr const char* kFields[] = {"expression", "joints", "head_rotation", "head_translation"};
  Out<1, -1> expression;
  Out<1, -1, 3> joints;
  Out<1, 3> head_rotation, head_translation;

  FaceParameterGradients(const Group<FaceParameterGradients>& group, const FaceArrays& face) {
    group.read(expression, joints, head_rotation, head_translation);
    require(same_shape(expression, face.expression) && same_shape(joints, face.joints),
            "a gradient must have the shape of its array");
  }
};

// The inputs of both passes.
struct Rider {
  const mien::RigTopology& topology;
  bool in_head;
  FaceArrays face;
  LocalGaussians<const float> local;

  Rider(const mien::FaceModelData& model, const mien::RigTopology& topology, bool in_head,
        const Group<FaceArrays>& face_group, const Group<LocalGaussians<const float>>& local_group)
      : topology(topology), in_head(in_head), face(model, face_group), local(local_group, topology.face_index.size()) {
    require(face.size() == 1 && face.head_rotation.has_value() && topology.vertex_count == model.vertices,
            "the arrays do not fit the face model");
  }
  size_t count() const { return topology.face_index.size(); }
  mien::FacePose pose() const {
    mien::FacePose pose = face.pose(0);
    if (in_head) pose.head_rotation = pose.head_translation = nullptr;
    return pose;
  }
  mien::RigArrays rig(const Ride& ride) const {
    const float* const means = ride.changes ? ride.changes->means.data() : local.means.data();
    return mien::rig_arrays(topology, ride.vertices.data(), means, local.quats.data(), local.log_scales.data());
  }
};

// Fills the changes, and the changed Gaussians in the frames of their triangles.
void change(const Rider& rider, const ChangeArrays& own, const ChangedArrays& changed, std::pair<float, float> weights,
            Ride& ride) {
  const mien::ChangeBases bases = own.bases(rider.topology);
  ride.changes.emplace(rider.count(), bases.network);
  const mien::ChangeSquares squares = mien::change_gaussians(
      bases, ride.changes->kept(), {rider.local.means.data(), rider.local.opacity_logits.data(), own.sh.data()},
      changed.changes(), {ride.changes->means.data(), ride.changes->opacity_logits.data(), changed.sh.data()});
  *changed.linear.data() = weights.first * static_cast<float>(squares.linear);
  *changed.features.data() = weights.second * static_cast<float>(squares.features);
}

Ride forward(const mien::FaceModelData& model, const mien::RigTopology& topology, bool in_head,
             const Group<FaceArrays>& face_group, const Group<LocalGaussians<const float>>& local_group,
             const Group<PosedGaussians<float>>& posed_group, const std::optional<Group<ChangeArrays>>& change_group,
             const std::optional<Group<ChangedArrays>>& changed_group, std::pair<float, float> weights) {
  const Rider rider(model, topology, in_head, face_group, local_group);
  const PosedGaussians<float> posed(posed_group, rider.count());
  require(!in_head || posed.head_pose.has_value(), "`head_pose` is missing");
  require(change_group.has_value() == changed_group.has_value(), "changes need arrays to be filled");
  std::optional<ChangeArrays> changes;
  std::optional<ChangedArrays> changed;
  if (change_group) changes.emplace(*change_group, topology);
  if (changed_group) changed.emplace(*changed_group, *changes);
  const nb::gil_scoped_release release;
  Ride ride(model, topology, in_head);
  if (changes) change(rider, *changes, *changed, weights, ride);
  mien::pose_face(model, rider.pose(), ride.shaped.data(), ride.vertices.data());
  mien::rig_forward(rider.rig(ride), ride.frames.data(), {posed.means.data(), posed.quats.data(), posed.scales.data()});
  const float* const logits = ride.changes ? ride.changes->opacity_logits.data() : rider.local.opacity_logits.data();
  mien::sigmoid(logits, static_cast<int64_t>(rider.count()), posed.opacities.data());
  if (in_head) {
    mien::head_pose(rider.face.head_rotation->data(), rider.face.head_translation->data(), posed.head_pose->data());
  }
  return ride;
}

// Fills the gradients of the face from those of its vertices and, in the head frame, from that of its pose.
void face_backward(const mien::FaceModelData& model, const Ride& ride, const Rider& rider, const float* by_vertices,
                   const std::optional<In<4, 4>>& by_head_pose, const FaceParameterGradients& gradients) {
  const size_t floats = 3 * static_cast<size_t>(model.vertices);
  mien::Recycled<float> by_rest(floats + 3 * static_cast<size_t>(model.joints));
  float *rotation = gradients.head_rotation.data(), *translation = gradients.head_translation.data();
  mien::pose_face_backward(model, rider.pose(), ride.shaped.data(), by_vertices,
                           {by_rest.data(), by_rest.data() + floats, gradients.expression.data(),
                            gradients.joints.data(), rotation, translation});
  if (!ride.in_head) return;
  for (int i = 0; i < 3; ++i) rotation[i] = translation[i] = 0;
  if (!by_head_pose) return;
  mien::head_pose_backward(rider.face.head_rotation->data(), by_head_pose->data(), rotation);
  for (int row = 0; row < 3; ++row) translation[row] = by_head_pose->data()[4 * row + 3];
}

void backward(const Ride& ride, const mien::FaceModelData& model, const mien::RigTopology& topology,
              const Group<FaceArrays>& face_group, const Group<LocalGaussians<const float>>& local_group,
              const In<-1, 3>& scales, const In<-1>& opacities,
              const Group<PosedGaussians<const float>>& by_posed_group,
              const Group<LocalGaussians<float>>& local_gradient_group,
              const std::optional<Group<FaceParameterGradients>>& face_gradient_group) {
  const Rider rider(model, topology, ride.in_head, face_group, local_group);
  require(ride.is_of(model, topology), "the ride belongs to another model or topology");
  const size_t count = rider.count();
  const PosedGaussians<const float> by_posed(by_posed_group, count);
  const LocalGaussians<float> by_local(local_gradient_group, count);
  std::optional<FaceParameterGradients> by_face;
  if (face_gradient_group) by_face.emplace(*face_gradient_group, rider.face);
  require(scales.shape(0) == count && opacities.shape(0) == count,
          "posed Gaussians and their gradients must have one row per Gaussian");
  const nb::gil_scoped_release release;
  std::optional<mien::Recycled<float>> by_vertices;
  if (by_face) by_vertices.emplace(3 * static_cast<size_t>(model.vertices));
  mien::rig_backward(
      topology, rider.rig(ride), ride.frames.data(), scales.data(),
      {by_posed.means.data(), by_posed.quats.data(), by_posed.scales.data(), false, by_local.means.data(),
       by_local.quats.data(), by_local.log_scales.data(), by_face ? by_vertices->data() : nullptr});
  mien::sigmoid_backward(opacities.data(), by_posed.opacities.data(), static_cast<int64_t>(count),
                         by_local.opacity_logits.data());
  if (by_face) face_backward(model, ride, rider, by_vertices->data(), by_posed.head_pose, *by_face);
}

// Fills the gradients of bases, features and layers, from those that `backward` filled of the changed Gaussians.
void changes_backward(const Ride& ride, const mien::RigTopology& topology, const Group<ChangeArrays>& change_group,
                      const Group<ChangedArrays>& changed_group, std::pair<float, float> weights,
                      const In<-1, 3>& by_means, const In<-1>& by_opacity_logits,
                      const Group<ByChangedArrays>& by_changed_group,
                      const Group<ChangeGradientArrays>& gradient_group) {
  const size_t count = topology.face_index.size();
  require(ride.topology == &topology && ride.changes.has_value(), "the ride belongs to another topology");
  const ChangeArrays own(change_group, topology);
  const ChangedArrays changed(changed_group, own);
  const ByChangedArrays by(by_changed_group, count);
  const ChangeGradientArrays out(gradient_group, own);
  require(by_means.shape(0) == count && by_opacity_logits.shape(0) == count,
          "a gradient must have one row per Gaussian");
  const mien::ChangeBases bases = own.bases(topology);
  require(ride.changes->fits(count, bases.network), "the ride had other changes");
  const float linear = by.linear ? weights.first * *by.linear->data() : 0;
  const float features = by.features ? weights.second * *by.features->data() : 0;
  const mien::GaussianChanges<float> values = changed.changes();
  const nb::gil_scoped_release release;
  mien::change_gaussians_backward(
      bases, ride.changes->kept(),
      {values.offset, values.color, values.opacity, values.feature_color, values.feature_opacity},
      {{by_means.data(), by_opacity_logits.data(), data_of(by.sh)},
       by.changes(),
       linear,
       features,
       data_of(out.offset_basis),
       data_of(out.color_basis),
       data_of(out.opacity_basis),
       data_of(out.features),
       data_of(out.weight1),
       data_of(out.weight2)});
}

}  // namespace

void bind_ride(nb::module_& module) {
  nb::class_<Ride>(module, "Ride", "What `ride_backward` needs of `ride`.");
  bind_group<LocalGaussians<float>>(module);
  bind_group<PosedGaussians<float>>(module);
  bind_group<FaceParameterGradients>(module);
  bind_group<ChangeArrays>(module);
  bind_group<ChangedArrays>(module);
  bind_group<ByChangedArrays>(module);
  bind_group<ChangeGradientArrays>(module);
  module.def("ride", &forward, "model"_a, "topology"_a, "in_head"_a, "face"_a, "local"_a, "posed"_a,
             "changes"_a.none() = nb::none(), "changed"_a.none() = nb::none(), "weights"_a = std::pair(0.0f, 0.0f),
             "Fills the Gaussians in world space or, with `in_head`, in the head frame together with its pose.");
  module.def("ride_changes_backward", &changes_backward, "ride"_a, "topology"_a, "changes"_a, "changed"_a, "weights"_a,
             "by_means"_a, "by_opacity_logits"_a, "by_changed"_a, "gradients"_a,
             "Fills the gradients of what changes Gaussians, from those that `ride_backward` filled.");
  module.def("ride_backward", &backward, "ride"_a, "model"_a, "topology"_a, "face"_a, "local"_a, "scales"_a,
             "opacities"_a, "by_posed"_a, "by_local"_a, "by_face"_a.none(),
             "Fills the gradients, from the scales and opacities that `ride` filled. `by_face` may be None.");
}
