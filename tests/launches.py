"""Count what a GPU would have to launch in a step of training, and what its host would wait for, on the device `meta`.

An operator counts as one launch, unless it makes a view or takes memory, and so does a kernel of mien's own
(`mien.kernels`). gsplat is replaced by functions that launch nothing. `python tests/launches.py METHOD` prints a table.
"""

import traceback
from collections import Counter
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

META = torch.zeros((), device="meta")
_FREE = {"_unsafe_view", "detach", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "alias"}
_pinned: list[Tensor] = []


class Launches(TorchDispatchMode):
    """Counts launches by the function of mien that asks for them, and lists what waits for a GPU."""

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
            if waits(name, args, kwargs or {}):
                self.waits.append(f"{place()}: {name}")
            aliases = [one.alias_info for one in func._schema.returns]
            view = any(alias is not None and not alias.is_write for alias in aliases)
            if not view and name not in _FREE:
                self.by_function[place()] += 1
        return result


def on_meta(values: Any) -> bool:
    """Return whether one of the tensors is on the device `meta`."""
    if isinstance(values, Tensor):
        return values.device.type == "meta"
    return isinstance(values, list | tuple) and any(on_meta(one) for one in values)


def waits(name: str, args: Any, kwargs: dict[str, Any]) -> bool:
    """Return whether an operator copies from memory that is not pinned, or is told to wait for its copy."""
    if name in ("_to_copy", "copy_"):
        source = args[-1] if name == "copy_" and isinstance(args[-1], Tensor) else args[name == "copy_"]
        at_once = kwargs.get("non_blocking", False) or (name == "copy_" and args[-1] is True)
        return source.is_cpu and not (at_once and any(source is one for one in _pinned))
    if name.startswith("index"):  # An index in the memory of the CPU is copied.
        indices = [one for one in args[1:] if isinstance(one, list | tuple)]
        return any(isinstance(one, Tensor) and one.is_cpu for own in indices for one in own)
    return False


def pin(tensor: Tensor) -> Tensor:
    """Return a copy that counts as pinned, in place of `Tensor.pin_memory`, which needs a GPU."""
    _pinned.append(tensor.clone())
    del _pinned[:-100]
    return _pinned[-1]


def place() -> str:
    """Return the innermost function of mien that runs, or that made the node whose backward pass runs."""
    frames = [frame for frame in traceback.extract_stack() if "/src/mien/" in frame.filename]
    node: Any = torch._C._current_autograd_node()
    if node is not None and not (frames and frames[-1].name == "backward"):
        lines = [line for line in node.metadata.get("traceback_", []) if "/src/mien/" in line]
        if lines:
            path, _, name = lines[-1].split("\n")[0].split(", ")
            return f"{path.rpartition('/')[2].rstrip(chr(34))}:{name[3:]} backward"
    own = [frame for frame in frames if not frame.filename.endswith("kernels.py")]
    return f"{own[-1].filename.rpartition('/')[2]}:{own[-1].name}" if own else "?"


class _Nothing(torch.autograd.Function):
    """Results of some shapes that depend on tensors, without launches."""

    @staticmethod
    def forward(ctx: Any, shapes: tuple[tuple[int, ...], ...], *inputs: Tensor) -> Any:
        ctx.save_for_backward(*inputs)
        made = [torch.empty(shape, device="meta") for shape in shapes]
        return tuple(made) if len(made) > 1 else made[0]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return None, *(torch.empty_like(one) for one in ctx.saved_tensors)


def no_gsplat() -> ModuleType:
    """Return a module with the functions of gsplat that mien calls, which launch nothing."""
    gsplat: Any = ModuleType("gsplat")

    def projection(means, covars, quats, scales, viewmats, *_, **__):
        n, given = len(means), [one for one in (means, covars, quats, scales, viewmats) if one is not None]
        projected = _Nothing.apply(((1, n, 2), (1, n), (1, n, 3)), *given)
        return torch.empty(1, n, 2, dtype=torch.int32, device="meta"), *projected, None

    def pixels(means2d, conics, colors, opacities, width, height, *_, backgrounds=None, **__):
        given = (means2d, conics, colors, opacities, backgrounds)
        return _Nothing.apply(((1, height, width, 3), (1, height, width, 1)), *given)

    gsplat.fully_fused_projection, gsplat.rasterize_to_pixels = projection, pixels
    gsplat.spherical_harmonics = lambda _, directions, sh: _Nothing.apply((directions.shape,), directions, sh)
    gsplat.isect_tiles = lambda *_, **__: (torch.empty(8, dtype=torch.int64, device="meta"),) * 3
    gsplat.isect_offset_encode = lambda _, __, columns, rows: torch.empty(1, rows, columns, device="meta")
    return gsplat
