// What a training step poses, in one call each way: a face, and the Gaussians that ride on its triangles. One timestep;
// only a door: the work is that of face.h, rig.h and activation.h.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>

#include "activation.h"
#include "arrays.h"
#include "face.h"
#include "memory.h"
#include "rig.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// What the backward pass needs of its forward pass.
struct Ride {
  // Whose it is: not read, and maybe gone. Another model at the same place would have to be of the same sizes.
  const void *model, *topology;
  int vertex_count;
  size_t face_count;
  mien::Recycled<float> shaped, vertices;
  mien::Recycled<mien::TriangleFrame> frames;

  Ride(const mien::FaceModelData& model, const mien::RigTopology& topology)
      : model(&model),
        topology(&topology),
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

// The inputs of both passes.
struct Rider {
  const mien::FaceModelData& model;
  const mien::RigTopology& topology;
  const In<-1, 3>&rest, &joint_rest;
  const In<1, -1>& expression;
  const In<1, -1, 3>& joints;
  const In<1, 3>&head_rotation, &head_translation;
  bool in_head;
  const In<-1, 3>& means;
  const In<-1, 4>& quats;
  const In<-1, 3>& log_scales;
  const In<-1>& opacity_logits;

  size_t count() const { return topology.face_index.size(); }
  void check() const {
    const auto same = [](size_t length, auto other) { return length == static_cast<size_t>(other); };
    require(same(rest.shape(0), model.vertices) && same(joint_rest.shape(0), model.joints) &&
                same(expression.shape(1), model.expressions) && same(joints.shape(1), model.free_joints) &&
                topology.vertex_count == model.vertices,
            "the arrays do not fit the face model");
    require(means.shape(0) == count() && quats.shape(0) == count() && log_scales.shape(0) == count() &&
                opacity_logits.shape(0) == count(),
            "one row of every parameter a Gaussian");
  }
  mien::FacePose pose() const {
    return {rest.data(),
            joint_rest.data(),
            expression.data(),
            joints.data(),
            in_head ? nullptr : head_rotation.data(),
            in_head ? nullptr : head_translation.data()};
  }
  mien::RigArrays rig(const Ride& ride) const {
    return mien::rig_arrays(topology, ride.vertices.data(), means.data(), quats.data(), log_scales.data());
  }
};

Ride forward(const mien::FaceModelData& model, const mien::RigTopology& topology, const In<-1, 3>& rest,
             const In<-1, 3>& joint_rest, const In<1, -1>& expression, const In<1, -1, 3>& joints,
             const In<1, 3>& head_rotation, const In<1, 3>& head_translation, bool in_head, const In<-1, 3>& means,
             const In<-1, 4>& quats, const In<-1, 3>& log_scales, const In<-1>& opacity_logits,
             const Out<1, -1, 3>& world_means, const Out<1, -1, 4>& world_quats, const Out<1, -1, 3>& world_scales,
             const Out<-1>& opacities, const Out<1, 4, 4>& head_pose) {
  const Rider rider{model,   topology, rest,  joint_rest, expression,    joints, head_rotation, head_translation,
                    in_head, means,    quats, log_scales, opacity_logits};
  rider.check();
  const size_t count = rider.count();
  require(world_means.shape(1) == count && world_quats.shape(1) == count && world_scales.shape(1) == count &&
              opacities.shape(0) == count,
          "the outputs do not fit");
  const nb::gil_scoped_release release;
  Ride ride(model, topology);
  mien::pose_face(model, rider.pose(), ride.shaped.data(), ride.vertices.data());
  mien::rig_forward(rider.rig(ride), ride.frames.data(), {world_means.data(), world_quats.data(), world_scales.data()});
  mien::sigmoid(opacity_logits.data(), static_cast<int64_t>(count), opacities.data());
  if (in_head) mien::head_pose(head_rotation.data(), head_translation.data(), head_pose.data());
  return ride;
}

void backward(const Ride& ride, const mien::FaceModelData& model, const mien::RigTopology& topology,
              const In<-1, 3>& rest, const In<-1, 3>& joint_rest, const In<1, -1>& expression,
              const In<1, -1, 3>& joints, const In<1, 3>& head_rotation, const In<1, 3>& head_translation, bool in_head,
              const In<-1, 3>& means, const In<-1, 4>& quats, const In<-1, 3>& log_scales, const In<-1>& opacity_logits,
              const In<1, -1, 3>& world_scales, const In<-1>& opacities, const In<1, -1, 3>& by_means,
              const In<1, -1, 4>& by_quats, const In<1, -1, 3>& by_scales, const In<-1>& by_opacities,
              const std::optional<In<1, 4, 4>>& by_head_pose, const Out<-1, 3>& grad_means,
              const Out<-1, 4>& grad_quats, const Out<-1, 3>& grad_log_scales, const Out<-1>& grad_logits,
              const std::optional<Out<1, -1>>& grad_expression, const std::optional<Out<1, -1, 3>>& grad_joints,
              const std::optional<Out<1, 3>>& grad_rotation, const std::optional<Out<1, 3>>& grad_translation) {
  const Rider rider{model,   topology, rest,  joint_rest, expression,    joints, head_rotation, head_translation,
                    in_head, means,    quats, log_scales, opacity_logits};
  rider.check();
  require(ride.is_of(model, topology), "the ride is another model's or another topology's");
  const size_t count = rider.count(), floats = 3 * static_cast<size_t>(model.vertices);
  for (const size_t length : {world_scales.shape(1), opacities.shape(0), by_means.shape(1), by_quats.shape(1),
                              by_scales.shape(1), by_opacities.shape(0), grad_means.shape(0), grad_quats.shape(0),
                              grad_log_scales.shape(0), grad_logits.shape(0)})
    require(length == count, "one row of every gradient a Gaussian");
  const bool face = grad_expression.has_value();
  require(!face || (grad_joints && grad_rotation && grad_translation && same_shape(*grad_expression, expression) &&
                    same_shape(*grad_joints, joints)),
          "a gradient must have the shape of its array");
  const nb::gil_scoped_release release;
  std::optional<mien::Recycled<float>> by_vertices, by_rest;
  if (face) by_vertices.emplace(floats), by_rest.emplace(floats + 3 * static_cast<size_t>(model.joints));
  mien::rig_backward(topology, rider.rig(ride), ride.frames.data(), world_scales.data(),
                     {by_means.data(), by_quats.data(), by_scales.data(), false, grad_means.data(), grad_quats.data(),
                      grad_log_scales.data(), face ? by_vertices->data() : nullptr});
  mien::sigmoid_backward(opacities.data(), by_opacities.data(), static_cast<int64_t>(count), grad_logits.data());
  if (!face) return;
  mien::pose_face_backward(model, rider.pose(), ride.shaped.data(), by_vertices->data(),
                           {by_rest->data(), by_rest->data() + floats, grad_expression->data(), grad_joints->data(),
                            grad_rotation->data(), grad_translation->data()});
  if (!in_head) return;
  for (int i = 0; i < 3; ++i) grad_rotation->data()[i] = grad_translation->data()[i] = 0;
  if (!by_head_pose) return;
  mien::head_pose_backward(head_rotation.data(), by_head_pose->data(), grad_rotation->data());
  for (int row = 0; row < 3; ++row) grad_translation->data()[row] = by_head_pose->data()[4 * row + 3];
}

}  // namespace

void bind_ride(nb::module_& module) {
  nb::class_<Ride>(module, "Ride", "What `ride_backward` needs of `ride`.");
  module.def("ride", &forward, "model"_a, "topology"_a, "rest"_a, "joint_rest"_a, "expression"_a, "joints"_a,
             "head_rotation"_a, "head_translation"_a, "in_head"_a, "means"_a, "quats"_a, "log_scales"_a,
             "opacity_logits"_a, "world_means"_a, "world_quats"_a, "world_scales"_a, "opacities"_a, "head_pose"_a,
             "Fills the Gaussians in world space; or in the head frame, and that frame's pose.");
  module.def("ride_backward", &backward, "ride"_a, "model"_a, "topology"_a, "rest"_a, "joint_rest"_a, "expression"_a,
             "joints"_a, "head_rotation"_a, "head_translation"_a, "in_head"_a, "means"_a, "quats"_a, "log_scales"_a,
             "opacity_logits"_a, "world_scales"_a, "opacities"_a, "by_means"_a, "by_quats"_a, "by_scales"_a,
             "by_opacities"_a, "by_head_pose"_a.none(), "grad_means"_a, "grad_quats"_a, "grad_log_scales"_a,
             "grad_logits"_a, "grad_expression"_a.none(), "grad_joints"_a.none(), "grad_rotation"_a.none(),
             "grad_translation"_a.none(), "Fills the gradients; those of the face only if they are given.");
}
