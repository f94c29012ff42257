"""Parts that files of Gaussians in a pose share: checked arrays and unit rotations."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mien.errors import UserError

if TYPE_CHECKING:
    import mien.gaussians

MAX_GAUSSIANS = 2_000_000
"""Largest number of Gaussians that is read: a head has tens of thousands, and memory grows with it."""
_NAMES = ("means", "quats", "scales", "opacities", "sh")


def finite_arrays(path: Path, gaussians: "mien.gaussians.Gaussians") -> tuple[np.ndarray, ...]:
    """Means, quaternions, scales, opacities and SH of unbatched Gaussians in world space as float32."""
    assert not gaussians.batched, "write one timestep: gaussians.timestep(t)"
    assert gaussians.T_world_local is None, "move the Gaussians to world space: in_world(gaussians)"
    arrays = tuple(getattr(gaussians, name).detach().cpu().float().numpy() for name in _NAMES)
    bad = np.zeros(len(gaussians), bool)
    for array in arrays:
        bad |= ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if bad.any():
        raise UserError(f"{path}: {bad.sum()} of {len(bad)} Gaussians are NaN or infinite; train it again")
    return arrays


def gaussians_of(arrays: Iterable[np.ndarray]) -> "mien.gaussians.Gaussians":
    """Gaussians of means, quaternions, scales, opacities and SH."""
    import torch

    from mien.gaussians import Gaussians

    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays))


def unit_quats(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Quaternions of length 1. One without a length becomes the identity."""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, quats / np.maximum(lengths, 1e-12), (1.0, 0.0, 0.0, 0.0)).astype(quats.dtype)
