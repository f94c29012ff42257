"""Compile every kernel that a step of training launches for an NVIDIA GPU, which needs none: what an interpreter runs
may be refused by the compiler. `python tests/compiled_kernels.py` prints the names of those that compile."""

import os
from dataclasses import replace
from typing import Any

os.environ.pop("TRITON_INTERPRET", None)  # before Triton is imported
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")  # Triton asks for a choice

import pytest
import torch
import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

import mien.kernels

HOPPER = GPUTarget("cuda", 90, 32)
TYPES = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.uint8: "*u8", torch.bool: "*i1"}
_compiled: set[str] = set()


def signature(value: Any, path: tuple[int, ...], constants: dict[Any, Any]) -> Any:
    """Return the type of an argument as Triton names it. What is None is a constant."""
    if isinstance(value, Tensor):
        return TYPES[value.dtype]
    if isinstance(value, tuple):
        return tuple(signature(one, (*path, index), constants) for index, one in enumerate(value))
    if value is None or (type(value) is int and value == 1):  # as Triton treats both at a launch
        constants[path] = value
        return "constexpr"
    return "i32" if isinstance(value, int) else "fp32"


def launch(kernel: Any, programs: int, *arguments: Any, **named: Any) -> None:
    """Compile a kernel in place of `mien.kernels.launch`."""
    constants: dict[Any, Any] = {(kernel.arg_names.index(name),): value for name, value in named.items()}
    types = {
        name: signature(value, (index,), constants)
        for index, (name, value) in enumerate(zip(kernel.arg_names, arguments, strict=False))
    }
    types |= dict.fromkeys(named, "constexpr")
    if (key := f"{kernel.fn.__name__} {types} {constants}") not in _compiled:
        triton.compile(ASTSource(kernel, types, constants), target=HOPPER)
        print(kernel.fn.__name__, flush=True)
        _compiled.add(key)


def main() -> None:
    """Take one step on `meta` of each of four trainings, cover Gaussians, as footage of a mouth does, and move heads
    and cameras."""
    mien.kernels.launch = launch  # before the files of kernels take it
    from mien.face.posing_gpu import head_poses
    from mien.render.around_gsplat import view_directions
    from mien.training import PRESETS
    from mien.training.training_gpu import covered
    from test_device_stalls import LONG, default, pretend, steps, without_features

    with pytest.MonkeyPatch.context() as patched:
        pretend(patched)
        trainings = [default()]
        one: dict[str, Any] = {"frames_per_step": 1}
        for method, changes in (("gaussian_avatars", {}), ("headgas", {}), ("mono_gaussian_avatar", one)):
            paper = PRESETS["paper"]
            trainings.append((replace(paper.config(method), **changes), paper.settings_of(method)))
        for config, settings in trainings:
            list(steps(without_features(config), replace(settings, **LONG), 1))
    like = torch.zeros(5, 4, 3, device="meta", requires_grad=True)
    rows = torch.zeros(5, dtype=torch.long, device="meta")
    sh, opacities = covered(like, like[:, 0, 0], rows.bool(), rows, (0.1, 0.2, 0.3))
    (sh.sum() + opacities.sum()).backward()
    turns, viewmat = like[:, 0], torch.zeros(4, 4, device="meta", requires_grad=True)
    (head_poses(turns, turns).sum() + view_directions(turns, viewmat).sum()).backward()


if __name__ == "__main__":
    main()
