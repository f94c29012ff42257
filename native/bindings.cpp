// The Python module `mien._native`. Each operation binds itself in its own bind_*.cpp; this file only lists them.
#include <nanobind/nanobind.h>

void bind_mesh(nanobind::module_& module);

NB_MODULE(_native, module) {
  module.doc() = "mien's native core. Private: only the autograd functions in mien.render and mien.avatar call it.";
  bind_mesh(module);
}
