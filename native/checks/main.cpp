// Runs every check on every instruction set that this build and machine have.
#include "checks.h"
#include "pool.h"
#include "rasterize.h"

int main() {
  checks::check_pool();
  checks::check_mesh();
  for (const char* isa : {"avx512", "avx2", "sse4", "baseline"}) {
    if (!mien::set_rasterize_isa(isa)) continue;
    std::printf("checking %s\n", isa);
    checks::check_rasterizer();
    checks::check_training_step();
    checks::check_face();
    checks::check_feature_network();
  }
  mien::set_thread_count(1);  // joins the workers
  std::printf("all checks passed\n");
}
