"""What a rasterizer refuses, in words."""

import torch
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians


def check_shapes(gaussians: Gaussians, background: Tensor) -> None:
    """Raise ValueError for shapes, dtypes and devices that do not fit together."""
    count = len(gaussians)
    expected = {"quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    tensors = named_tensors(gaussians, background)
    for name, shape in expected.items():
        if tuple(tensors[name].shape[-len(shape) :]) != shape:
            raise ValueError(f"rasterize: {name} has shape {tuple(tensors[name].shape)}, expected [..., {shape}]")
    if tuple(gaussians.sh.shape[-3:]) not in [(count, coefficients, 3) for coefficients in (1, 4, 9, 16)]:
        raise ValueError(f"rasterize: sh has shape {tuple(gaussians.sh.shape)}, expected [..., {count}, 1|4|9|16, 3]")
    means = gaussians.means
    for name, tensor in tensors.items():
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"rasterize: {name} is {tensor.dtype} on {tensor.device}, but means is {means.dtype} on {means.device}"
            )


def check_finite(gaussians: Gaussians, camera: Camera, background: Tensor) -> None:
    """Raise ValueError that names the first NaN or infinity by tensor and index."""
    tensors = named_tensors(gaussians, background) | {"camera.viewmat": camera.viewmat, "camera.K": camera.K}
    # One question for all: on a GPU every answer makes the host wait.
    if bool(torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).all()):
        return
    for name, tensor in tensors.items():
        bad = ~torch.isfinite(tensor)
        if bad.any():
            index = bad.nonzero()[0].tolist()
            raise ValueError(f"rasterize: {name}{index} is {tensor[tuple(index)].item()}; every input must be finite")


def named_tensors(gaussians: Gaussians, background: Tensor) -> dict[str, Tensor]:
    """The inputs under the names that users know them by."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return {name: getattr(gaussians, name) for name in names} | {"background": background}
