// Compiled once per instruction set, with MIEN_ISA set to its name (CMakeLists.txt); rasterize.cpp picks one at run
// time.
#include "rasterize_blend_backward.h"
#include "rasterize_project_backward.h"

namespace mien {

extern const Kernels MIEN_KERNELS;
const Kernels MIEN_KERNELS = {project, blend, blend_backward, project_backward};

}  // namespace mien
