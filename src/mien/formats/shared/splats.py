"""What the writers of Gaussians share: checked arrays and unit rotations."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.errors import UserError
from mien.gaussians import Gaussians

_NAMES = ("means", "quats", "scales", "opacities", "sh")


def finite_arrays(path: Path, gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    """Means, quaternions, scales, opacities and SH of unbatched Gaussians as float32."""
    arrays = tuple(getattr(gaussians, name).detach().cpu().float().numpy() for name in _NAMES)
    bad = np.zeros(len(gaussians), bool)
    for array in arrays:
        bad |= ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if bad.any():
        raise UserError(f"{path}: {bad.sum()} of {len(bad)} Gaussians are NaN or infinite; train it again")
    return arrays


def unit_quats(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Quaternions of length 1. One without a length becomes the identity."""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, quats / np.maximum(lengths, 1e-12), (1.0, 0.0, 0.0, 0.0)).astype(quats.dtype)
