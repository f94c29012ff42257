#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>

#include "arrays.h"
#include "rig.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Faces = Array<const int64_t, nb::shape<-1, 3>>;
using FaceIndex = Array<const int64_t, nb::ndim<1>>;
using Vertices = In<-1, -1, 3>;
using Frames = nb::shape<-1, -1, mien::kTriangleFrameFloats>;

// Gaussians in units of their triangles: values, or gradients of them.
template <typename T>
struct LocalShapes {
  static constexpr char kName[] = "LocalShapes";
  static constexpr const char* kFields[] = {"means", "quats", "log_scales"};
  Array<T, nb::shape<-1, 3>> means;
  Array<T, nb::shape<-1, 4>> quats;
  Array<T, nb::shape<-1, 3>> log_scales;

  LocalShapes(const Group<LocalShapes>& group, size_t count) {
    group.read(means, quats, log_scales);
    require(means.shape(0) == count && quats.shape(0) == count && log_scales.shape(0) == count,
            "parameters and their gradients must have one row per Gaussian");
  }
};

template <typename A>
void check_batch(const A& array, size_t batch, size_t rows) {
  require(array.shape(0) == batch && array.shape(1) == rows, "the arrays belong to different rigs");
}

// The same in world space, at each timestep.
template <typename T>
struct WorldShapes {
  static constexpr char kName[] = "WorldShapes";
  static constexpr const char* kFields[] = {"means", "quats", "scales"};
  Array<T, nb::shape<-1, -1, 3>> means;
  Array<T, nb::shape<-1, -1, 4>> quats;
  Array<T, nb::shape<-1, -1, 3>> scales;

  WorldShapes(const Group<WorldShapes>& group, size_t batch, size_t count) {
    group.read(means, quats, scales);
    check_batch(means, batch, count);
    check_batch(quats, batch, count);
    check_batch(scales, batch, count);
  }
};

void rig_forward(const Vertices& vertices, const Faces& faces, const FaceIndex& face_index,
                 const Group<LocalShapes<const float>>& local_group, const Array<float, Frames>& frames,
                 const Group<WorldShapes<float>>& world_group) {
  const size_t batch = vertices.shape(0), count = face_index.shape(0);
  const LocalShapes<const float> local(local_group, count);
  const WorldShapes<float> world(world_group, batch, count);
  check_batch(frames, batch, faces.shape(0));
  const nb::gil_scoped_release release;
  const auto vertex_count = static_cast<int64_t>(vertices.shape(1)), face_count = static_cast<int64_t>(faces.shape(0));
  check_indices(faces, vertex_count, "a face names a vertex that does not exist");
  check_indices(face_index, face_count, "a Gaussian names a face that does not exist");
  mien::RigArrays rig{vertices.data(),    vertex_count,       faces.data(),
                      face_count,         face_index.data(),  static_cast<int64_t>(count),
                      local.means.data(), local.quats.data(), local.log_scales.data()};
  for (size_t b = 0; b < batch; ++b) {
    mien::rig_forward(
        rig, reinterpret_cast<mien::TriangleFrame*>(frames.data()) + b * face_count,
        {world.means.data() + b * count * 3, world.quats.data() + b * count * 4, world.scales.data() + b * count * 3});
    rig.vertices += vertex_count * 3;
  }
}

mien::RigTopology make_topology(size_t vertex_count, const Faces& faces, const FaceIndex& face_index) {
  const nb::gil_scoped_release release;
  checked_length(vertex_count, mien::kMostRigVertices, "vertices");
  checked_length(faces.shape(0), mien::kMostRigFaces, "faces");
  checked_length(face_index.shape(0), "Gaussians");
  return {static_cast<int64_t>(vertex_count), faces.data(), static_cast<int64_t>(faces.shape(0)), face_index.data(),
          static_cast<int64_t>(face_index.shape(0))};
}

void rig_backward(const mien::RigTopology& topology, const Vertices& vertices,
                  const Group<LocalShapes<const float>>& local_group, const Array<const float, Frames>& frames,
                  const In<-1, -1, 3>& scales, const Group<WorldShapes<const float>>& by_world_group,
                  const Group<LocalShapes<float>>& gradient_group, const std::optional<Out<-1, -1, 3>>& grad_vertices) {
  const size_t batch = vertices.shape(0), count = topology.face_index.size(), faces = topology.faces.size() / 3;
  const auto vertex_count = static_cast<size_t>(topology.vertex_count);
  require(batch > 0, "the batch has no timesteps");
  check_batch(vertices, batch, vertex_count);
  check_batch(frames, batch, faces);
  check_batch(scales, batch, count);
  if (grad_vertices) check_batch(*grad_vertices, batch, vertex_count);
  const LocalShapes<const float> local(local_group, count);
  const WorldShapes<const float> by_world(by_world_group, batch, count);
  const LocalShapes<float> gradients(gradient_group, count);
  const nb::gil_scoped_release release;
  for (size_t b = 0; b < batch; ++b) {
    const mien::RigArrays rig = mien::rig_arrays(topology, vertices.data() + b * vertex_count * 3, local.means.data(),
                                                 local.quats.data(), local.log_scales.data());
    mien::rig_backward(
        topology, rig, reinterpret_cast<const mien::TriangleFrame*>(frames.data()) + b * faces,
        scales.data() + b * count * 3,
        {by_world.means.data() + b * count * 3, by_world.quats.data() + b * count * 4,
         by_world.scales.data() + b * count * 3, b > 0, gradients.means.data(), gradients.quats.data(),
         gradients.log_scales.data(), grad_vertices ? grad_vertices->data() + b * vertex_count * 3 : nullptr});
  }
}

}  // namespace

void bind_rig(nb::module_& module) {
  module.attr("TRIANGLE_FRAME_FLOATS") = mien::kTriangleFrameFloats;
  bind_group<LocalShapes<float>>(module);
  bind_group<WorldShapes<float>>(module);
  module.def("rig_forward", &rig_forward, "vertices"_a, "faces"_a, "face_index"_a, "local"_a, "frames"_a, "world"_a,
             "Fills the triangles' frames and the Gaussians in world space at b timesteps.");
  nb::class_<mien::RigTopology>(module, "RigTopology", "The Gaussians bound to each triangle, for sums in parallel.");
  module.def("make_rig_topology", &make_topology, "vertex_count"_a, "faces"_a, "face_index"_a);
  module.def("rig_backward", &rig_backward, "topology"_a, "vertices"_a, "local"_a, "frames"_a, "scales"_a, "by_world"_a,
             "gradients"_a, "grad_vertices"_a.none(),
             "Fills the gradients, summed over the timesteps. `grad_vertices` may be None.");
}
