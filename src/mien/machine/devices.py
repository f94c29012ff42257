"""The device that holds the tensors of training and rendering: the CPU, or a CUDA GPU through gsplat."""

import shutil
from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal

from mien.errors import UserError
from mien.machine.progress import say

if TYPE_CHECKING:
    import torch

DeviceName = Literal["cpu", "cuda", "auto"]
"""`auto` chooses a CUDA GPU if torch finds one and gsplat is installed, and the CPU otherwise."""

_OR_CPU = "or leave --device cuda out to use the processor"


def check_device(name: DeviceName) -> None:
    """Check a device name as far as that is possible without torch."""
    if name == "cuda" and find_spec("gsplat") is None:
        raise UserError(
            "--device cuda: needs a CUDA GPU and gsplat, which is not installed; if there is such a GPU, install "
            "gsplat with `.venv/bin/uv pip install gsplat==1.5.3` (it compiles its kernels at first use, with the CUDA "
            f"toolkit's nvcc), {_OR_CPU}"
        )


def choose_device(name: DeviceName) -> "torch.device":
    """The device for a name. Prints a message if it is a GPU, or if `auto` finds none."""
    import torch

    if name == "cpu":
        return torch.device("cpu")
    if name == "auto":
        lacking = ["torch finds no CUDA GPU"] * (not torch.cuda.is_available())
        lacking += ["gsplat is not installed"] * (find_spec("gsplat") is None)
        lacking = lacking or ["gsplat finds no nvcc to compile its kernels with"] * (not _has_kernels())
        if lacking:
            say(f"--device auto: {' and '.join(lacking)}; using the processor")
            return torch.device("cpu")
    check_device(name)
    if not torch.cuda.is_available():
        built = "is built without CUDA" if torch.version.cuda is None else f"(CUDA {torch.version.cuda}) finds no GPU"
        raise UserError(
            f"--device cuda: torch {torch.__version__} {built}; check that `nvidia-smi` lists a GPU and that its "
            f"driver is new enough, {_OR_CPU}"
        )
    if not _has_kernels():
        raise UserError(
            f"--device cuda: gsplat finds no nvcc to compile its kernels with; install the CUDA toolkit "
            f"{torch.version.cuda} and put its folder bin on the PATH, {_OR_CPU}"
        )
    say(f"{torch.cuda.get_device_name()}: gsplat compiles its kernels at first use, which takes some minutes, once")
    return torch.device("cuda")


def _has_kernels() -> bool:
    """Whether gsplat's kernels came with it, or can be compiled. Without nvcc it would say so in its first step."""
    return shutil.which("nvcc") is not None or find_spec("gsplat.csrc") is not None


def gpu_memory_mb(device: "torch.device", *, restart: bool = False) -> float:
    """The most memory that tensors of this process have had on a GPU since a restart, in MiB; 0 for the CPU."""
    import torch

    if device.type != "cuda":
        return 0.0
    if restart:
        torch.cuda.reset_peak_memory_stats(device)
    return torch.cuda.max_memory_allocated(device) / (1 << 20)


def like_on(device: "torch.device | str") -> "torch.Tensor":
    """A float32 scalar on a device, to pass to the method `to(like)` of the value objects."""
    import torch

    return torch.zeros((), device=device)


def fetch(tensor: "torch.Tensor") -> "Callable[[], torch.Tensor]":
    """Begin to copy a tensor to the CPU, and return a function that waits for the copy. Call it in another thread."""
    import torch

    if tensor.is_cpu:
        return lambda: tensor
    held = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True)
    copied = torch.cuda.current_stream(tensor.device).record_event()

    def result() -> torch.Tensor:
        copied.synchronize()
        return held

    return result


def upload(tensor: "torch.Tensor", like: "torch.Tensor") -> "torch.Tensor":
    """The tensor on the device of `like`, with its float dtype. A GPU reads it from pinned memory, without waiting."""
    held = tensor if like.is_cpu or not tensor.is_cpu or tensor.is_pinned() else tensor.pin_memory()
    return held.to(like.device, like.dtype if tensor.is_floating_point() else tensor.dtype, non_blocking=True)
