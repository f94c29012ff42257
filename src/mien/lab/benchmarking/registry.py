"""Benchmarks of training steps by method (`mien bench train-step`). Needs no torch: they import it when they run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StepBenchmark:
    """The benchmark of a method's training step. Both functions yield rows, and are named as "MODULE:FUNCTION"."""

    suite: str
    """Function that takes the seconds for each row, and measures on the CPU."""
    on_gpu: str | None = None
    """Function that takes a tensor on the GPU and the seconds for each row. None if nothing measures there."""


_ROOM = "mien.lab.benchmarking"
STEP_BENCHMARKS = {
    "gaussian_avatars": StepBenchmark(f"{_ROOM}.train_step:train_step_suite", f"{_ROOM}.device:train_step_rows"),
    "headgas": StepBenchmark(f"{_ROOM}.headgas_step:headgas_suite"),
    "mono_gaussian_avatar": StepBenchmark(f"{_ROOM}.mono_step:mono_suite"),
}
