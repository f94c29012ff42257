// The Python module `mien._native`. Each operation binds itself in its own bind_*.cpp; this file only lists them.
#include <nanobind/nanobind.h>

void bind_activation(nanobind::module_& module);
void bind_baked_points(nanobind::module_& module);
void bind_composite(nanobind::module_& module);
void bind_expression_change(nanobind::module_& module);
void bind_face(nanobind::module_& module);
void bind_feature_network(nanobind::module_& module);
void bind_memory(nanobind::module_& module);
void bind_mesh(nanobind::module_& module);
void bind_mesh_align(nanobind::module_& module);
void bind_photometric(nanobind::module_& module);
void bind_point_network(nanobind::module_& module);
void bind_rig(nanobind::module_& module);
void bind_ride(nanobind::module_& module);
void bind_rasterize(nanobind::module_& module);
void bind_skin_points(nanobind::module_& module);
void bind_training(nanobind::module_& module);

NB_MODULE(_native, module) {
  nanobind::set_leak_warnings(false);  // a picture that lives until the interpreter ends is no leak
  module.doc() = "mien's native core. Private: only the autograd functions in mien.render and mien.avatar call it.";
  bind_activation(module);
  bind_baked_points(module);
  bind_composite(module);
  bind_expression_change(module);
  bind_face(module);
  bind_feature_network(module);
  bind_memory(module);
  bind_mesh(module);
  bind_mesh_align(module);
  bind_photometric(module);
  bind_point_network(module);
  bind_rig(module);
  bind_ride(module);  // after the face and the rig, whose classes it takes
  bind_rasterize(module);
  bind_skin_points(module);
  bind_training(module);
}
