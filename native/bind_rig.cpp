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
using Rows3 = Array<const float, nb::shape<-1, 3>>;
using Rows4 = Array<const float, nb::shape<-1, 4>>;
using Frames = nb::shape<-1, -1, mien::kTriangleFrameFloats>;

mien::RigArrays rig_arrays(const Array<const float, nb::shape<-1, -1, 3>>& vertices, const Faces& faces,
                           const FaceIndex& face_index, const Rows3& local_means, const Rows4& local_quats,
                           const Rows3& log_scales) {
  const size_t count = face_index.shape(0);
  require(local_means.shape(0) == count && local_quats.shape(0) == count && log_scales.shape(0) == count,
          "one row of every parameter a Gaussian");
  const auto vertex_count = static_cast<int64_t>(vertices.shape(1)), face_count = static_cast<int64_t>(faces.shape(0));
  check_indices(faces, vertex_count, "a face names a vertex that does not exist");
  check_indices(face_index, face_count, "a Gaussian names a face that does not exist");
  return {vertices.data(),    vertex_count,       faces.data(),
          face_count,         face_index.data(),  static_cast<int64_t>(count),
          local_means.data(), local_quats.data(), log_scales.data()};
}

template <typename A>
void check_batch(const A& array, size_t batch, size_t rows) {
  require(array.shape(0) == batch && array.shape(1) == rows, "arrays of different rigs");
}

void rig_forward(const Array<const float, nb::shape<-1, -1, 3>>& vertices, const Faces& faces,
                 const FaceIndex& face_index, const Rows3& local_means, const Rows4& local_quats,
                 const Rows3& log_scales, const Array<float, Frames>& frames,
                 const Array<float, nb::shape<-1, -1, 3>>& means, const Array<float, nb::shape<-1, -1, 4>>& quats,
                 const Array<float, nb::shape<-1, -1, 3>>& scales) {
  const nb::gil_scoped_release release;
  mien::RigArrays rig = rig_arrays(vertices, faces, face_index, local_means, local_quats, log_scales);
  const size_t batch = vertices.shape(0);
  check_batch(frames, batch, rig.face_count);
  check_batch(means, batch, rig.count);
  check_batch(quats, batch, rig.count);
  check_batch(scales, batch, rig.count);
  for (size_t b = 0; b < batch; ++b) {
    mien::rig_forward(
        rig, reinterpret_cast<mien::TriangleFrame*>(frames.data()) + b * rig.face_count,
        {means.data() + b * rig.count * 3, quats.data() + b * rig.count * 4, scales.data() + b * rig.count * 3});
    rig.vertices += rig.vertex_count * 3;
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

void rig_backward(const mien::RigTopology& topology, const Array<const float, nb::shape<-1, -1, 3>>& vertices,
                  const Rows3& local_means, const Rows4& local_quats, const Rows3& log_scales,
                  const Array<const float, Frames>& frames, const Array<const float, nb::shape<-1, -1, 3>>& scales,
                  const Array<const float, nb::shape<-1, -1, 3>>& grad_means,
                  const Array<const float, nb::shape<-1, -1, 4>>& grad_quats,
                  const Array<const float, nb::shape<-1, -1, 3>>& grad_scales,
                  const Array<float, nb::shape<-1, 3>>& grad_local_means,
                  const Array<float, nb::shape<-1, 4>>& grad_local_quats,
                  const Array<float, nb::shape<-1, 3>>& grad_log_scales,
                  const std::optional<Array<float, nb::shape<-1, -1, 3>>>& grad_vertices) {
  const nb::gil_scoped_release release;
  const size_t batch = vertices.shape(0), count = topology.face_index.size(), faces = topology.faces.size() / 3;
  const auto vertex_count = static_cast<size_t>(topology.vertex_count);
  require(batch > 0, "a batch of no timesteps");
  check_batch(vertices, batch, vertex_count);
  check_batch(frames, batch, faces);
  for (const auto& array : {scales, grad_means, grad_scales}) check_batch(array, batch, count);
  check_batch(grad_quats, batch, count);
  if (grad_vertices) check_batch(*grad_vertices, batch, vertex_count);
  for (const size_t length : {local_means.shape(0), local_quats.shape(0), log_scales.shape(0),
                              grad_local_means.shape(0), grad_local_quats.shape(0), grad_log_scales.shape(0)})
    require(length == count, "one row of every parameter and gradient a Gaussian");
  for (size_t b = 0; b < batch; ++b) {
    const mien::RigArrays rig = mien::rig_arrays(topology, vertices.data() + b * vertex_count * 3, local_means.data(),
                                                 local_quats.data(), log_scales.data());
    const mien::RigGradients gradients{grad_means.data() + b * count * 3,
                                       grad_quats.data() + b * count * 4,
                                       grad_scales.data() + b * count * 3,
                                       b > 0,
                                       grad_local_means.data(),
                                       grad_local_quats.data(),
                                       grad_log_scales.data(),
                                       grad_vertices ? grad_vertices->data() + b * vertex_count * 3 : nullptr};
    mien::rig_backward(topology, rig, reinterpret_cast<const mien::TriangleFrame*>(frames.data()) + b * faces,
                       scales.data() + b * count * 3, gradients);
  }
}

}  // namespace

void bind_rig(nb::module_& module) {
  module.attr("TRIANGLE_FRAME_FLOATS") = mien::kTriangleFrameFloats;
  module.def("rig_forward", &rig_forward, "vertices"_a.noconvert(), "faces"_a.noconvert(), "face_index"_a.noconvert(),
             "local_means"_a.noconvert(), "local_quats"_a.noconvert(), "log_scales"_a.noconvert(),
             "frames"_a.noconvert(), "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert());
  nb::class_<mien::RigTopology>(module, "RigTopology", "Who rides on which triangle, ready for sums in parallel.");
  module.def("make_rig_topology", &make_topology, "vertex_count"_a, "faces"_a.noconvert(), "face_index"_a.noconvert());
  module.def("rig_backward", &rig_backward, "topology"_a, "vertices"_a.noconvert(), "local_means"_a.noconvert(),
             "local_quats"_a.noconvert(), "log_scales"_a.noconvert(), "frames"_a.noconvert(), "scales"_a.noconvert(),
             "grad_means"_a.noconvert(), "grad_quats"_a.noconvert(), "grad_scales"_a.noconvert(),
             "grad_local_means"_a.noconvert(), "grad_local_quats"_a.noconvert(), "grad_log_scales"_a.noconvert(),
             "grad_vertices"_a.noconvert().none());
}
