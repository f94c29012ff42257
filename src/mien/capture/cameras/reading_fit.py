"""Measure how well readings of a calibration fit the pictures: points of the face, seen by several cameras at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mien.camera import Camera
from mien.capture.cameras.head_path import consensus, project, rays_of
from mien.capture.cameras.readings import Reading

_POINTS = (1, 4, 6, 168, 33, 133, 263, 362, 61, 291, 0, 17, 98, 327, 70, 300, 468, 473)
"""Landmarks that slide little along the face if it turns: nose, corners of eyes and mouth, lips, brows, irises."""
_NOSE, _AROUND = 1, (33, 263, 61, 291)
INSIDE_OUT = -0.1
"""Height of the nose over the corners of eyes and mouth, in distances of the eyes, below which a face is concave. Two
cameras nearly agree on such a face if they are read as mirrored in depth."""
_MOST_TIMESTEPS = 24
_AGREEING = 0.5
"""Least share of the found faces that are at one place."""
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
    """Rank the readings, best first. Those that fit equally stay in their order.

    Args:
        landmarks: MediaPipe's landmarks in pixels of the readings' cameras; NaN where there is no face.
        readings: the readings.
    """
    seen = np.isfinite(landmarks[..., 0, 0]).sum(axis=1)
    several = np.flatnonzero(seen >= 2)
    chosen = several[:: -(-len(several) // _MOST_TIMESTEPS) or 1]
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
    if not len(landmarks) or agrees.sum() < _AGREEING * np.isfinite(boxes[..., 0]).sum():
        return Ranked(reading, np.inf, np.inf)
    points = _places(landmarks[:, :, list(_POINTS)], agrees, cameras)
    around = _places(landmarks[:, :, [_NOSE, *_AROUND]], agrees, cameras)
    missed = np.stack([project(points, camera) for camera in cameras], axis=1) - landmarks[:, :, list(_POINTS)]
    distances = np.linalg.norm(missed[agrees], axis=-1)
    distances[~np.isfinite(distances)] = np.inf
    sides = np.sqrt(np.prod(boxes[..., 2:] - boxes[..., :2], axis=-1))[agrees]
    if _height(around, agrees, cameras) < INSIDE_OUT:
        return Ranked(reading, np.inf, np.inf)
    return Ranked(reading, float(np.median(distances)), float(np.median(distances / sides[:, None])))


def _places(
    pixels: Float[np.ndarray, "t c p 2"], agrees: Bool[np.ndarray, "t c"], cameras: Sequence[Camera]
) -> Float[np.ndarray, "t p 3"]:
    """Return the points nearest to the rays of the cameras that agree; NaN where there are no such cameras."""
    directions = np.stack([rays_of(pixels[:, :, index], cameras) for index in range(pixels.shape[2])], axis=2)
    origins = np.stack([camera.position.numpy() for camera in cameras]).astype(np.float64)
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    across = np.where(agrees[:, :, None, None, None], across, 0)
    summed = across.sum(axis=1)
    summed[~agrees.any(axis=1)] = np.nan
    return np.linalg.solve(summed, np.einsum("tcpij,cj->tpi", across, origins)[..., None])[..., 0]


def _height(points: Float[np.ndarray, "t p 3"], agrees: Bool[np.ndarray, "t c"], cameras: Sequence[Camera]) -> float:
    """Return how far the nose is before the corners of eyes and mouth, in distances of the eyes, as cameras see it."""
    depths = np.stack([points @ camera.viewmat[2, :3].numpy().astype(np.float64) for camera in cameras], axis=1)
    apart = np.linalg.norm(points[:, 1] - points[:, 2], axis=-1)
    heights = (depths[..., 1:].mean(axis=-1) - depths[..., 0]) / apart[:, None]
    return float(np.median(heights[agrees]))
