"""Rotations in numpy: what `mien.rotation` has in torch."""

import numpy as np
from jaxtyping import Float

_SMALL_ANGLE_SQUARED = 1e-8


def matrix_from_axis_angle(axis_angle: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotation matrices of axis-angle vectors in radians (Rodrigues' formula), float64."""
    axis_angle = axis_angle.astype(np.float64)
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = squared < _SMALL_ANGLE_SQUARED
    safe = np.where(small, 1.0, squared)
    angle = np.sqrt(safe)
    sine = np.where(small, 1 - squared / 6, np.sin(angle) / angle)
    cosine = np.where(small, 0.5 - squared / 24, (1 - np.cos(angle)) / safe)
    x, y, z = np.moveaxis(axis_angle, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*axis_angle.shape, 3)
    return np.eye(3) + sine * cross + cosine * (cross @ cross)


def rigid_transform(
    rotations: Float[np.ndarray, "*b 3 3"], translations: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 4 4"]:
    """Homogeneous matrices that rotate, then translate."""
    transforms = np.zeros((*rotations.shape[:-2], 4, 4), rotations.dtype)
    transforms[..., :3, :3], transforms[..., :3, 3], transforms[..., 3, 3] = rotations, translations, 1
    return transforms
