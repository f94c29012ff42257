"""Rotations in numpy, the counterpart of `mien.rotation` in torch."""

import numpy as np
from jaxtyping import Float

from mien.machine import exact

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
    return np.eye(3) + sine * cross + cosine * exact.product(cross, cross)


def compose_rigid(first: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """`first @ second`, summed in a fixed order, because the order of a matrix product depends on the machine."""
    columns = [first[:, axis, None] * second[axis] for axis in range(4)]
    return ((columns[0] + columns[1]) + columns[2]) + columns[3]


def axis_angle_from_matrix(matrices: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Axis-angle vectors, angle in 0..pi, of rotation matrices, from the unit quaternion's largest component."""
    flat = matrices.reshape(-1, 3, 3)
    vectors = np.zeros((len(flat), 3))
    for index, m in enumerate(flat):
        # The symmetric matrix 4 q q^T of a wxyz quaternion. Its largest row is the best conditioned.
        outer = np.array([
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ])  # fmt: skip
        quat = outer[np.argmax(np.diagonal(outer))]
        quat = quat / exact.length(quat) * (1 if quat[0] >= 0 else -1)
        length = exact.length(quat[1:])
        angle = 2 * np.arctan2(length, quat[0])
        vectors[index] = quat[1:] * (angle / length if length > 1e-9 else 2.0)
    return vectors.reshape(matrices.shape[:-1])


def rotation_of(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"] | None:
    """The rotation nearest to a rotation times a scale, or None if the matrix is not near one."""
    u, sizes, vt = np.linalg.svd(matrix)
    if sizes[2] < 1e-6 or sizes[0] > 1.2 * sizes[2] or np.linalg.det(matrix) <= 0:
        return None
    return u @ vt
