"""Errors for inputs that a rasterizer refuses."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from mien.camera import Camera
from mien.errors import UserError
from mien.gaussians import Gaussians


class CannotDrawError(ValueError):
    """Gaussians that no rasterizer can draw."""


class NotFiniteError(CannotDrawError):
    """An input of a rasterizer holds NaN or infinity."""


class TooManyPairsError(CannotDrawError):
    """The Gaussians touch more tiles in total than the native rasterizer can count."""


def check_shapes(gaussians: Gaussians, background: Tensor) -> None:
    """Raise ValueError if shapes, dtypes or devices do not fit together."""
    means, quats, scales, opacities, sh = _parts(gaussians)
    count, dtype, device = len(gaussians), means.dtype, means.device
    for name, tensor, shape in (
        ("quats", quats, (count, 4)), ("scales", scales, (count, 3)), ("opacities", opacities, (count,))
    ):  # fmt: skip
        if tensor.shape[-len(shape) :] != shape:
            raise ValueError(f"rasterize: {name} has shape {tuple(tensor.shape)}, expected [..., {shape}]")
    if sh.shape[-3::2] != (count, 3) or sh.shape[-2] not in (1, 4, 9, 16):
        raise ValueError(f"rasterize: sh has shape {tuple(sh.shape)}, expected [..., {count}, 1|4|9|16, 3]")
    for name, tensor in (
        ("quats", quats), ("scales", scales), ("opacities", opacities), ("sh", sh), ("background", background)
    ):  # fmt: skip
        if tensor.dtype != dtype or tensor.device != device:
            raise ValueError(
                f"rasterize: {name} is {tensor.dtype} on {tensor.device}, but means is {dtype} on {device}"
            )


def check_finite(gaussians: Gaussians, camera: Camera, background: Tensor) -> None:
    """Raise a `NotFiniteError` that names the tensor and index of the first NaN or infinity."""
    names = ("means", "quats", "scales", "opacities", "sh", "background", "camera.viewmat", "camera.K")
    tensors = dict(zip(names, (*_parts(gaussians), background, camera.viewmat, camera.K), strict=True))
    # Check all tensors at once, because on a GPU every answer makes the host wait.
    if bool(torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).all()):
        return
    for name, tensor in tensors.items():
        bad = ~torch.isfinite(tensor)
        if bad.any():
            index = bad.nonzero()[0].tolist()
            told = f"rasterize: {name}{index} is {tensor[tuple(index)].item()}; every input must be finite"
            raise NotFiniteError(told)


@contextmanager
def drawable(what: str, remedy: str) -> Iterator[None]:
    """Turn a `CannotDrawError` inside the context into a message for the user, with what cannot be drawn."""
    try:
        yield
    except CannotDrawError as error:
        raise UserError(f"{what}: cannot be drawn ({error}); {remedy}") from None


def _parts(gaussians: Gaussians) -> tuple[Tensor, ...]:
    return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
