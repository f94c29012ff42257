"""Benchmarks of `mien bench`: timings on this machine, and tables of quality.

Here are the benchmarks of training steps by method. This needs no torch: they import it when they run.
"""

_ROOM = "mien.lab.benchmarking"
STEP_BENCHMARKS = {
    "gaussian_avatars": f"{_ROOM}.train_step:train_step_suite",
    "headgas": f"{_ROOM}.method_steps:headgas_suite",
    "mono_gaussian_avatar": f"{_ROOM}.method_steps:mono_suite",
}
"""Method -> "MODULE:FUNCTION", which takes the seconds for each row, measures on the CPU and yields rows."""
GPU_BENCHMARKS = {
    "gaussian_avatars": f"{_ROOM}.train_step:gpu_rows",
    "headgas": f"{_ROOM}.method_steps:headgas_on_gpu",
    "mono_gaussian_avatar": f"{_ROOM}.method_steps:mono_on_gpu",
    "point_avatar": f"{_ROOM}.method_steps:point_avatar_on_gpu",
    "textured_mesh": f"{_ROOM}.method_steps:textured_mesh_on_gpu",
}
"""Method -> "MODULE:FUNCTION", which takes a tensor on the GPU and the seconds for each row, and yields rows."""
