"""Count what a GPU would have to launch in a step of training, on tensors of the device `meta`, and copies that wait.

An operator counts as one launch, unless it makes a view or takes memory; so does a fused operation (`mien.kernels`).
gsplat is replaced by functions that launch nothing. `python tests/launches.py` prints a table by function.
"""

import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

META = torch.zeros((), device="meta")
_FREE = {"_unsafe_view", "detach", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "alias"}


class Launches(TorchDispatchMode):
    """Counts launches by the function of mien that asks for them, and copies between devices."""

    def __init__(self) -> None:
        super().__init__()
        self.by_function: Counter[str] = Counter()
        self.waits: list[str] = []

    @property
    def count(self) -> int:
        return self.by_function.total()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func._schema.name.removeprefix("aten::")
        if on_meta(result) or on_meta(args):
            if name in ("_to_copy", "copy_") and not on_meta(args[-1:]) and from_pageable(args, kwargs or {}):
                self.waits.append(place())
            aliases = [one.alias_info for one in func._schema.returns]
            view = any(alias is not None and not alias.is_write for alias in aliases)
            if not view and name not in _FREE:
                self.by_function[f"{place()} {name}"] += 1
        return result


def on_meta(values: Any) -> bool:
    """Return whether one of the tensors is on the device `meta`."""
    if isinstance(values, Tensor):
        return values.device.type == "meta"
    return isinstance(values, list | tuple) and any(on_meta(one) for one in values)


def from_pageable(args: Any, kwargs: dict[str, Any]) -> bool:
    """Return whether a copy is one from memory that is not pinned, or one that waits."""
    return False


def place() -> str:
    """Return the innermost function of mien that runs, or that made the node whose backward pass runs."""
    frames = [frame for frame in traceback.extract_stack() if "/src/mien/" in frame.filename]
    node, backward = torch._C._current_autograd_node(), ""
    if node is not None and not frames[-1].name == "backward":
        lines = [line for line in node.metadata.get("traceback_", []) if "/src/mien/" in line]
        if lines:
            path, number, name = lines[-1].split("\n")[0].split(", ")
            return f"{path.split('/')[-1].rstrip(chr(34))}:{name[3:]} backward"
    return f"{frames[-1].filename.split('/')[-1]}:{frames[-1].name}" if frames else "?"


class _Nothing(torch.autograd.Function):
    """A result of some shapes that depends on tensors, without launches."""

    @staticmethod
    def forward(ctx: Any, shapes: tuple[tuple[int, ...], ...], *inputs: Tensor) -> Any:
        ctx.save_for_backward(*inputs)
        made = tuple(torch.empty(shape, device="meta") for shape in shapes)
        return made if len(made) > 1 else made[0]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return None, *(torch.empty_like(one) if one.is_floating_point() else None for one in ctx.saved_tensors)


def no_gsplat() -> ModuleType:
    """Return a module with the functions of gsplat that mien calls, which launch nothing."""
    gsplat: Any = ModuleType("gsplat")

    def projection(means, covars, quats, scales, viewmats, Ks, width, height, **_):
        given = [one for one in (means, covars, quats, scales, viewmats) if one is not None]
        n = len(means)
        means2d, depths, conics = _Nothing.apply(((1, n, 2), (1, n), (1, n, 3)), *given)
        return torch.empty(1, n, 2, dtype=torch.int32, device="meta"), means2d, depths, conics, None

    def harmonics(degree, directions, coefficients, masks=None):
        return _Nothing.apply((directions.shape,), directions, coefficients)

    def tiles(means2d, radii, depths, *_, **__):
        empty = torch.empty(8, dtype=torch.int64, device="meta")
        return empty, empty, empty

    def pixels(means2d, conics, colors, opacities, width, height, *_, backgrounds=None, **__):
        given = (means2d, conics, colors, opacities, backgrounds)
        return _Nothing.apply(((1, height, width, 3), (1, height, width, 1)), *given)

    gsplat.fully_fused_projection, gsplat.spherical_harmonics = projection, harmonics
    gsplat.isect_tiles, gsplat.rasterize_to_pixels = tiles, pixels
    gsplat.isect_offset_encode = lambda *_: torch.empty(1, dtype=torch.int32, device="meta").expand(_[2] * _[3])
    return gsplat


