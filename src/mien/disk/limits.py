"""Limits on the content of files that others hand over: sizes of pictures, valid cameras, order of joints.

They are checked when a file is read, so that no later code meets a picture of 10^9 pixels, an index outside its array,
or a number that overflows.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mien.disk.reading import MAX_SIDE

MAX_NUMBER = 1e6
"""Largest magnitude of lengths in metres, coordinates in pixels, angles in radians, raw values and weights. Mien writes
far smaller numbers."""
MAX_FOCAL = 1e7
"""Largest focal length, in pixels."""
_RIGID = 1e-2
"""Tolerance for the last rows of K and viewmat, and for the deviation of R R^T from the identity."""


def checked_whole(value: object, low: int, high: int) -> int:
    """`value`, if it is a whole number from `low` to `high`; else a ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{value!r:.40} is not a whole number from {low} to {high}")
    return value


def checked_side(value: object) -> int:
    """`value`, if it can be a picture's width or height in pixels; else a ValueError."""
    return checked_whole(value, 1, MAX_SIDE)


def is_moderate(array: np.ndarray) -> bool:
    """Whether all numbers are finite and at most `MAX_NUMBER` in magnitude."""
    # The extremes need no memory; NaN is neither above nor below.
    return array.size == 0 or bool(array.max() <= MAX_NUMBER and array.min() >= -MAX_NUMBER)


def are_indices(array: np.ndarray, count: int) -> bool:
    """Whether all values are indices into an array of `count` entries."""
    return array.size == 0 or bool(int(array.min()) >= 0 and int(array.max()) < count)


def camera_fault(K: Any, viewmat: Any, width: object, height: object) -> str | None:
    """The reason why these cannot be a camera, or None if they can.

    `K` [3, 3], `width` and `height` are in pixels; `viewmat` [4, 4] goes from the world to the camera, in metres.
    """
    for value in (width, height):
        try:
            checked_side(value)
        except ValueError:
            return f"{width!r:.40}x{height!r:.40} pixels, not whole numbers from 1 to {MAX_SIDE}"
    K, viewmat = (np.asarray(matrix, np.float64) for matrix in (K, viewmat))
    if K.shape != (3, 3) or viewmat.shape != (4, 4):
        return "K must be 3x3 and viewmat 4x4 numbers"
    if not (np.isfinite(K).all() and np.isfinite(viewmat).all()):
        return "K and viewmat must be finite numbers"
    if np.abs(K).max() > MAX_FOCAL or min(K[0, 0], K[1, 1]) < 1 / MAX_FOCAL:
        return f"focal lengths {K[0, 0]:g} and {K[1, 1]:g}, which must be above 0 and at most {MAX_FOCAL:g} pixels"
    if np.abs(K[2] - (0, 0, 1)).max() > _RIGID:
        return "the last row of K must be 0 0 1"
    fault = rigid_fault(viewmat)
    if fault is not None:
        return f"viewmat is not a rotation and translation (world to camera, OpenCV axes): {fault}"
    if np.abs(viewmat[:3, 3]).max() > MAX_NUMBER:
        return f"it is more than {MAX_NUMBER:g} metres away"
    return None


def rigid_fault(matrix: Any) -> str | None:
    """The reason why a 4x4 matrix is not a rotation and a translation, or None if it is. Units do not matter.

    Coordinates are columns: the translation is in the last column, and the last row is 0 0 0 1.
    """
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return "it must be 4x4 finite numbers"
    if not has_last_row(matrix):
        if has_last_row(matrix.T):
            return "its last column is 0 0 0 1, so it is transposed; put the translation into the last column"
        return f"its last row is {' '.join(f'{value:g}' for value in matrix[3])}; it must be 0 0 0 1"
    turned = matrix[:3, :3]
    if (
        np.abs(turned).max() > 2
        or np.abs((turned[:, None] * turned[None]).sum(-1) - np.eye(3)).max() > _RIGID
        or np.linalg.det(turned) < 0
    ):
        return "its upper left 3x3 numbers are not a rotation"
    return None


def has_last_row(matrix: np.ndarray) -> bool:
    """Whether the last row of a 4x4 matrix is 0 0 0 1, as in every matrix that maps points to points."""
    return bool(np.abs(matrix[3] - (0, 0, 0, 1)).max() <= _RIGID)


def skeleton_fault(names: Sequence[Any], parents: Sequence[Any], free: Sequence[Any]) -> str | None:
    """The reason why these cannot be a model's `joint_names`, `joint_parents`, `joint_free`, or None if they can."""
    if not (len(names) == len(parents) == len(free)) or not names:
        return f"{len(names)} joint names, {len(parents)} parents and {len(free)} marks of free joints"
    if not all(isinstance(name, str) for name in names) or not all(isinstance(mark, bool) for mark in free):
        return "joint names that are not texts, or marks that are not true or false"
    if not all(isinstance(parent, int) and not isinstance(parent, bool) for parent in parents):
        return "parents of joints that are not whole numbers"
    if any(not -1 <= parent < index for index, parent in enumerate(parents)):
        return "a joint comes before its parent"
    return None
