"""Straighten pictures of a camera whose lens distorts, by OpenCV's model of lenses."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.errors import UserError
from mien.render.camera_paths import names_of_distortion

NAME = "distortion"
_LENGTHS = (4, 5, 8, 12, 14)
_ORDER = "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty"
_GRID = 65  # points along each side of the grid on which a distortion is checked


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens that distorts. Straight pictures have the same size and the same K as distorted ones."""

    camera: Camera
    """The camera without the distortion, for pictures of its size."""
    coefficients: tuple[float, ...]
    """OpenCV's coefficients, in its order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty."""

    def straighten(self, picture: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w *c"]:
        """Return the picture as an ideal lens shows it, in any resolution. Its border is repeated where it ends."""
        places, fractions = _maps(self, picture.shape[1], picture.shape[0])
        straight = cv2.remap(picture, places, fractions, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return straight.astype(np.uint8, copy=False)

    def straighten_points(self, points: Float[np.ndarray, "*n 2"], width: int, height: int) -> np.ndarray:
        """Return where an ideal lens shows pixels of a distorted picture of that size. NaN stays NaN."""
        K = self.matrix(width, height)
        straight = np.full(points.shape, np.nan)
        known = np.isfinite(points).all(axis=-1)
        if known.any():
            pixels = np.ascontiguousarray(points[known].reshape(-1, 1, 2)) - 0.5
            straight[known] = cv2.undistortPoints(pixels, K, np.array(self.coefficients), P=K)[:, 0] + 0.5
        return straight

    def folds(self) -> bool:
        """Whether two pixels of the straight picture show the same place of the distorted one."""
        K = self.matrix(_GRID, _GRID)
        coefficients = np.array(self.coefficients)
        places, _ = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, (_GRID, _GRID), cv2.CV_32FC2)
        if not np.isfinite(places).all():
            return True
        across, down = np.diff(places, axis=1)[:-1], np.diff(places, axis=0)[:, :-1]
        return bool((across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] <= 0).any())

    def matrix(self, width: int, height: int) -> Float[np.ndarray, "3 3"]:
        """Return K for a picture of that size in OpenCV's pixels, where the first one's centre is at 0, not at 0.5."""
        K = self.camera.resized(width, height).K.numpy().astype(np.float64)
        K[:2, 2] -= 0.5
        return K


def lens_of_entry(entry: dict[str, Any], camera: Camera, where: str) -> Lens | None:
    """Return the lens of a camera's entry in a calibration file, or None if it does not distort."""
    others = [name for name in names_of_distortion(entry) if name != NAME]
    if others:
        raise UserError(
            f"{where}: {others[0]} describes a lens in a way that mien does not read; give OpenCV's coefficients "
            f"{_ORDER[:14]} as a list `{NAME}`, or straighten the videos first and leave it out"
        )
    given = entry.get(NAME)
    if given is None:
        return None
    try:
        numbers = np.asarray(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if numbers.ndim == 2 and 1 in numbers.shape:
        numbers = numbers.ravel()  # OpenCV writes a matrix of one row or one column.
    if numbers.ndim == 1 and len(numbers) == 0:
        return None
    if numbers.ndim != 1 or (len(numbers) not in _LENGTHS and np.isfinite(numbers).all()):
        raise UserError(
            f"{where}: {NAME} has {numbers.size} coefficients; give {', '.join(map(str, _LENGTHS[:-1]))} or "
            f"{_LENGTHS[-1]} in OpenCV's order: {_ORDER}"
        )
    if not np.isfinite(numbers).all():
        raise UserError(f"{where}: {NAME} {given!r:.60} is not a list of numbers; give OpenCV's coefficients {_ORDER}")
    if not numbers.any():
        return None
    lens, K = Lens(camera, tuple(numbers.tolist())), camera.K
    if abs(float(K[0, 1])) > 1e-3 * float(K[0, 0]):
        raise UserError(f"{where}: has a {NAME} and a skew (K[0][1] = {float(K[0, 1]):g}), and OpenCV's model has no "
                        "skew; calibrate without it")  # fmt: skip
    if lens.folds():
        raise UserError(
            f"{where}: {NAME} folds the picture over itself; check the order of the coefficients ({_ORDER}), that they "
            "are not of a fisheye model, and that K is in pixels"
        )
    return lens


@lru_cache(maxsize=2)
def _maps(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    K = lens.matrix(width, height)
    return cv2.initUndistortRectifyMap(K, np.array(lens.coefficients), np.eye(3), K, (width, height), cv2.CV_16SC2)
