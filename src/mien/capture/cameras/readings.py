"""Check a calibration against what its cameras see, and say how it should be read.

It is read in other ways that are usual (`readings_of`), and these are ranked by how well points of the face, seen by
several cameras at once, fit the pictures (`rank_readings`).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.capture.cameras.head_path import consensus, project, triangulate
from mien.capture.person.backend import DetectorChoice
from mien.capture.person.crop import crop_around
from mien.capture.person.faces import LANDMARKS, LandmarkDetector
from mien.machine.progress import say
from mien.media.source import FrameSource
from mien.rotation import invert_rigid

_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Change between OpenCV's axes of a camera (y down, z forward) and OpenGL's (y up, z backward)."""
_MAX_NORMALIZED = 20.0
"""Largest number of K below which it cannot be in pixels. In picture widths, it is three degrees of view."""
_OTHER_SIZE = 0.15
"""Relative distance of a principal point from the middle at which intrinsics may be for another size of pictures."""
_OFF = 0.05
"""Distance of a principal point from the middle, in heights, below which it does not matter from where y counts."""
_RATIOS = (5 / 4, 4 / 3, 3 / 2, 2.0, 9 / 4, 5 / 2, 8 / 3, 3.0, 4.0, 9 / 2, 6.0)  # usual ratios of two sizes of pictures
_NEAR = 0.25  # largest relative difference between such a ratio and that of the principal points

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
    """Return all readings, the one as written first, then the simplest. K of pictures that are cropped has one."""
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
        ways.append((_scaled(lambda camera: (camera.width, camera.height)), (remedy,)))
    else:
        for scale in _other_sizes(cameras):
            remedy = f"K is for pictures of another size, so multiply its rows 1 and 2 by {scale:.4g}"
            ways.append((_scaled(lambda camera, scale=scale: (scale, scale)), (remedy,)))
    if max(abs(float(change(camera).K[1, 2]) / camera.height - 0.5) for camera in cameras for change, _ in ways) < _OFF:
        return ways
    below = "y of K counts from below, so write K[1][2] as height - K[1][2]"
    return ways + [(_from_below(change), (*remedies, below)) for change, remedies in ways]


def _scaled(factors: Callable[[Camera], tuple[float, float]]) -> _Change:
    return lambda camera: replace(camera, K=camera.K * camera.K.new_tensor([*factors(camera), 1.0])[:, None])


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

    def numbers(cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
        to_world = invert_rigid(cameras[0].viewmat.double())
        each = ((camera.K / camera.width, camera.viewmat.double() @ to_world) for camera in cameras)
        return torch.cat([matrix.double().flatten() for pair in each for matrix in pair])

    return bool((numbers(first) - numbers(second)).abs().max() < 1e-3)


_POINTS = (1, 4, 6, 168, 33, 133, 263, 362, 61, 291, 0, 17, 98, 327, 70, 300, 468, 473)
"""Landmarks that slide little along the face if it turns: nose, corners of eyes and mouth, lips, brows, irises."""
_NOSE, _AROUND = 1, (33, 263, 61, 291)
INSIDE_OUT = -0.1
"""Height of the nose over the corners of eyes and mouth, in distances of the eyes, below which a face is concave. Two
cameras nearly agree on such a face if they are read as mirrored in depth."""
_TIE_FACTOR, _TIE_SHARE = 1.5, 0.004
"""Two readings tie if the distances that they leave differ by less than this factor, or by this share of a face."""
_WRONG_FACTOR, _WRONG_SHARE = 2.0, 0.02
"""A reading is wrong if it misses by this many times as much as the best one, and by this share of a face."""


@dataclass(frozen=True, eq=False)
class Ranked:
    """A reading with its fit to the pictures."""

    reading: Reading
    pixels: float
    """Median distance between points of the face and where the cameras together place them. Infinite if the cameras do
    not agree at all."""
    share: float
    """The same as a share of the face's side in the pictures."""


def rank_readings(landmarks: Float[np.ndarray, "t c l 2"], readings: Sequence[Reading]) -> list[Ranked]:
    """Rank the readings, best first, by landmarks in pixels of their cameras (NaN where there is no face)."""
    several = np.flatnonzero(np.isfinite(landmarks[..., 0, 0]).sum(axis=1) >= 2)
    chosen = several[:: -(-len(several) // 24) or 1]
    landmarks = landmarks[chosen].astype(np.float64)
    boxes = np.concatenate([landmarks.min(axis=2), landmarks.max(axis=2)], axis=-1)
    return sorted((_fit(landmarks, boxes, reading) for reading in readings), key=lambda entry: entry.share)


def is_wrong(ranked: Sequence[Ranked]) -> bool:
    """Whether the calibration fits far worse as it is written than in the best reading."""
    return written_of(ranked).share > max(_WRONG_FACTOR * ranked[0].share, _WRONG_SHARE)


def written_of(ranked: Sequence[Ranked]) -> Ranked:
    """Return the reading of the calibration as it is written."""
    return next(entry for entry in ranked if not entry.reading.remedies)


def ties_of(ranked: Sequence[Ranked]) -> list[Ranked]:
    """Return the best reading and those that fit about as well, without corrections that change hardly anything."""
    best = ranked[0]
    limit = max(_TIE_FACTOR * best.share, best.share + _TIE_SHARE)
    tied = [entry for entry in ranked if np.isfinite(entry.share) and entry.share <= limit]
    changed = [set(entry.reading.remedies) for entry in tied]
    return [entry for entry, own in zip(tied, changed, strict=True) if not any(other < own for other in changed)]


def advice_of(ranked: Sequence[Ranked]) -> str:
    """Return what to correct in a calibration, as far as the pictures tell. Empty if no reading fits."""
    tied = ties_of(ranked)
    if not tied:
        return ""
    if len(tied) == 1:
        return f"{tied[0].reading.remedy} (points of the face then agree within {tied[0].pixels:.1f} px)"
    listed = "; or ".join(
        f"({number}) {entry.reading.remedy or 'all is right as it is'}, which leaves {entry.pixels:.1f} px"
        for number, entry in enumerate(tied, 1)
    )
    return f"the pictures cannot tell {len(tied)} readings apart, so find out which one holds: {listed}"


def _fit(landmarks: Float[np.ndarray, "t c l 2"], boxes: Float[np.ndarray, "t c 4"], reading: Reading) -> Ranked:
    agrees, cameras = consensus(boxes, reading.cameras).agrees, reading.cameras
    if not len(landmarks) or agrees.sum() < 0.5 * np.isfinite(boxes[..., 0]).sum():
        return Ranked(reading, np.inf, np.inf)
    points = triangulate(landmarks[:, :, list(_POINTS)], agrees, cameras)
    around = triangulate(landmarks[:, :, [_NOSE, *_AROUND]], agrees, cameras)
    missed = np.stack([project(points, camera) for camera in cameras], axis=1) - landmarks[:, :, list(_POINTS)]
    distances = np.linalg.norm(missed[agrees], axis=-1)
    distances[~np.isfinite(distances)] = np.inf
    sides = np.sqrt(np.prod(boxes[..., 2:] - boxes[..., :2], axis=-1))[agrees]
    if _height(around, agrees, cameras) < INSIDE_OUT:
        return Ranked(reading, np.inf, np.inf)
    return Ranked(reading, float(np.median(distances)), float(np.median(distances / sides[:, None])))


def _height(points: Float[np.ndarray, "t p 3"], agrees: Bool[np.ndarray, "t c"], cameras: Sequence[Camera]) -> float:
    """Return how far the nose is before the corners of eyes and mouth, in distances of the eyes, as cameras see it."""
    depths = np.stack([points @ camera.viewmat[2, :3].numpy().astype(np.float64) for camera in cameras], axis=1)
    apart = np.linalg.norm(points[:, 1] - points[:, 2], axis=-1)
    heights = (depths[..., 1:].mean(axis=-1) - depths[..., 0]) / apart[:, None]
    return float(np.median(heights[agrees]))


def warn_of_misfit(ranked: Sequence[Ranked]) -> None:
    """Warn if the landmarks of a finished capture fit another reading of its calibration far better."""
    if is_wrong(ranked):
        pixels = written_of(ranked).pixels
        apart = f"within {pixels:.1f} px" if np.isfinite(pixels) else "nowhere, or on a face that is inside out"
        say(
            f"warning: --calibration: as it is written, the cameras agree on points of the face {apart}; "
            f"{advice_of(ranked)}; then capture again"
        )


def some_timesteps(found: Bool[np.ndarray, "t c"]) -> list[int]:
    """Return up to eight timesteps at which several cameras find a face, evenly spread."""
    several = np.flatnonzero(found.sum(axis=1) >= 2)
    return several[:: -(-len(several) // 8) or 1].tolist()


def landmarks_at(
    frames: FrameSource, boxes: Float[np.ndarray, "t 4"], timesteps: Sequence[int], detector: DetectorChoice = "auto"
) -> Float[np.ndarray, "n l 2"]:
    """Return landmarks in pixels of the source's pictures at increasing timesteps; NaN where no face is found.

    `boxes` are left, top, right, bottom of the face in pixels at all timesteps; NaN for no face.
    """
    found = np.full((len(timesteps), LANDMARKS, 2), np.nan)
    places = {timestep: place for place, timestep in enumerate(timesteps) if np.isfinite(boxes[timestep, 0])}
    if not places:
        return found
    with LandmarkDetector(several_faces=False, detector=detector) as finder:
        for timestep, frame in enumerate(itertools.islice(frames.frames(), max(places) + 1)):
            if timestep in places:
                picture = frame.picture()
                height, width = picture.shape[:2]
                side = max(round(2.0 * float((boxes[timestep, 2:] - boxes[timestep, :2]).max())), 256)
                crop = crop_around(boxes[timestep], side, width, height, side)
                for face in finder.detect(crop.apply(picture))[:1]:
                    found[places[timestep]] = face + (crop.left, crop.top)
    return found
