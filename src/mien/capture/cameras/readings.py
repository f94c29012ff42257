"""Read a calibration in other ways that are usual, and rank these readings by how well they fit the pictures."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.rotation import invert_rigid

_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Change between OpenCV's axes of a camera (y down, z forward) and OpenGL's (y up, z backward)."""
_MAX_NORMALIZED = 20.0
"""Largest number of K below which it cannot be in pixels. In picture widths, it is three degrees of view."""
_OTHER_SIZE = 0.15
"""Relative distance of a principal point from the middle at which intrinsics may be for another size of pictures."""
_OFF = 0.05
"""Distance of a principal point from the middle, in heights, below which it does not matter from where y counts."""
_RATIOS = (5 / 4, 4 / 3, 3 / 2, 2.0, 9 / 4, 5 / 2, 8 / 3, 3.0, 4.0, 9 / 2, 6.0)
"""Usual ratios of two sizes of pictures."""
_NEAR = 0.25
"""Largest relative difference between such a ratio and that of the middles of pictures and principal points."""
_SAME = 1e-3
"""Largest difference between numbers of two readings that place the cameras alike."""

_Change = Callable[[Camera], Camera]


@dataclass(frozen=True, eq=False)
class Reading:
    """A way to read the numbers of a calibration."""

    remedies: tuple[str, ...]
    """What the numbers are, and how to write them as they should be. Empty for the reading as it is written."""
    cameras: tuple[Camera, ...]
    """The cameras, if the numbers are read that way."""

    @property
    def remedy(self) -> str:
        """All remedies as one text."""
        return "; and ".join(self.remedies)


def readings_of(cameras: Sequence[Camera], in_source: bool = True) -> list[Reading]:
    """Return all readings of a calibration, the one as it is written first, then the simplest ones.

    Args:
        cameras: the cameras as the calibration is read usually.
        in_source: whether their pictures are whole. Intrinsics of cropped pictures are read in one way only.
    """
    intrinsics = _intrinsics(cameras) if in_source else [(_unchanged, ())]
    found: list[Reading] = []
    for (change_K, remedy_K), (change, remedy) in itertools.product(intrinsics, _POSES):
        read = tuple(change(change_K(camera)) for camera in cameras)
        reading = Reading(tuple(filter(None, (remedy, *remedy_K))), read)
        if not any(_alike(reading.cameras, other.cameras) for other in found):
            found.append(reading)
    return found


def _unchanged(camera: Camera) -> Camera:
    return camera


def _pose(change: Callable[[Tensor], Tensor]) -> _Change:
    return lambda camera: replace(camera, viewmat=change(camera.viewmat.double()).to(camera.viewmat))


_POSES: tuple[tuple[_Change, str], ...] = (
    (_unchanged, ""),
    (_pose(invert_rigid), "the matrices go from camera to world, so write the inverse of each viewmat"),
    (
        _pose(lambda viewmat: _FLIP @ viewmat),
        "the axes are OpenGL's, so change the signs of rows 2 and 3 of each viewmat",
    ),
    (
        _pose(lambda viewmat: _FLIP @ invert_rigid(viewmat)),
        "the matrices go from camera to world with OpenGL's axes, so change the signs of columns 2 and 3 of each, and "
        "write its inverse as viewmat",
    ),
)
"""Ways to read viewmat: how each undoes a usual mistake, and its remedy."""


def _intrinsics(cameras: Sequence[Camera]) -> list[tuple[_Change, tuple[str, ...]]]:
    """Return the ways to read K that its numbers allow, and each also with y from below."""
    ways: list[tuple[_Change, tuple[str, ...]]] = [(_unchanged, ())]
    if max(float(camera.K[:2].abs().max()) for camera in cameras) < _MAX_NORMALIZED:
        remedy = "K is in parts of the picture, so multiply its row 1 by the width and row 2 by the height"
        ways.append((_from_parts, (remedy,)))
    else:
        for scale in _other_sizes(cameras):
            remedy = f"K is for pictures of another size, so multiply its rows 1 and 2 by {scale:.4g}"
            ways.append((_scaled(scale), (remedy,)))
    if max(abs(float(change(camera).K[1, 2]) / camera.height - 0.5) for camera in cameras for change, _ in ways) < _OFF:
        return ways
    below = "y of K counts from below, so write K[1][2] as height - K[1][2]"
    return ways + [(_from_below(change), (*remedies, below)) for change, remedies in ways]


def _from_parts(camera: Camera) -> Camera:
    return replace(camera, K=camera.K * camera.K.new_tensor([[camera.width], [camera.height], [1.0]]))


def _scaled(scale: float) -> _Change:
    return lambda camera: replace(camera, K=camera.K * camera.K.new_tensor([[scale], [scale], [1.0]]))


def _from_below(change: _Change) -> _Change:
    def turned(camera: Camera) -> Camera:
        K = change(camera).K.clone()
        K[1, 2] = camera.height - K[1, 2]
        return replace(camera, K=K)

    return turned


def _other_sizes(cameras: Sequence[Camera]) -> list[float]:
    """Return factors by which K may be too small, usual ones first, if principal points are far from the middle."""
    across = float(np.median([camera.width / (2 * max(float(camera.K[0, 2]), 1e-6)) for camera in cameras]))
    down = float(np.median([camera.height / (2 * max(float(camera.K[1, 2]), 1e-6)) for camera in cameras]))
    if abs(np.log(across)) < _OTHER_SIZE:
        return []
    usual = [ratio for larger in _RATIOS for ratio in (larger, 1 / larger)]
    near = [ratio for ratio in usual if min(abs(np.log(ratio / across)), abs(np.log(ratio / down))) < _NEAR]
    return near if any(abs(np.log(ratio / across)) < _OTHER_SIZE / 2 for ratio in near) else [*near, across]


def _alike(first: Sequence[Camera], second: Sequence[Camera]) -> bool:
    """Whether two readings place the cameras alike, seen from the first one."""
    return all(
        _near(one.K / one.width, other.K / other.width) and _near(_beside(one, first), _beside(other, second))
        for one, other in zip(first, second, strict=True)
    )


def _beside(camera: Camera, cameras: Sequence[Camera]) -> Float[Tensor, "4 4"]:
    return camera.viewmat.double() @ invert_rigid(cameras[0].viewmat.double())


def _near(first: Tensor, second: Tensor) -> bool:
    return bool((first - second).abs().max() < _SAME)
