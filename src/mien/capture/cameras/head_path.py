"""Where the head is in the world of several calibrated cameras, found from the boxes of its face in their pictures."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mien.camera import Camera
from mien.capture.person.crop import (
    CROP_LEAST_HEAD_SHARE,
    CROP_MOST_ASPECT,
    CROP_OUTLIERS,
    Crop,
    crop_around,
    whole_picture,
)
from mien.errors import UserError

_HEAD_RADIUS = 0.24
"""Radius in metres of the sphere about the middle of the face that a crop of a rig shows: head, hair and neck. Set by
eye."""
_HEAD_MOST_MISS = 0.5
"""Largest distance between a found face and the projected one, in sides of the found box, for the two to agree: heads
agree within 0.15 (log, 11-22)."""
_HEAD_LEAST_ANGLE = 0.03  # smallest angle between two rays that give a point, in radians


@dataclass(frozen=True, eq=False)
class HeadPath:
    """The middle of the face at each timestep, and the cameras that agree on it."""

    centers: Float[np.ndarray, "t 3"]
    """Position in world space, in metres. NaN where fewer than two cameras agree."""
    agrees: Bool[np.ndarray, "t c"]
    """Whether the face that a camera found is where the others see it."""

    @property
    def known(self) -> Bool[np.ndarray, " t"]:
        """Timesteps at which the position is known."""
        return np.isfinite(self.centers[:, 0])


def find_head_path(
    boxes: Float[np.ndarray, "t c 4"], cameras: Sequence[Camera], advise: Callable[[], str] = str
) -> HeadPath:
    """Find the head from its face boxes by consensus: the point that most cameras agree on, then least squares.

    A box that is no face (the back of a head, a picture on the wall) therefore does not move the point. Boxes are left,
    top, right, bottom in pixels of each camera's picture, NaN where there is no face. `advise` is called if the cameras
    do not fit, and returns what to correct in all of them, or an empty text.
    """
    path = consensus(boxes, cameras)
    if not path.known.any():
        names = "check first that each video or folder has the name of its own camera's id, then the offsets"
        remedy = advise() or names
        raise UserError(f"--calibration: no two cameras ever see the face in the same place; {remedy}")
    _check_unit(path, _sides(boxes), cameras, advise)
    return path


def consensus(boxes: Float[np.ndarray, "t c 4"], cameras: Sequence[Camera]) -> HeadPath:
    """Return the path on which most cameras agree, which is unknown throughout if they never do."""
    centers, sides = (boxes[..., :2] + boxes[..., 2:]) / 2, _sides(boxes)
    origins = np.stack([camera.position.numpy() for camera in cameras]).astype(np.float64)
    directions = rays_of(centers, cameras)
    best, best_cost = np.full((len(boxes), 3), np.nan), np.full(len(boxes), np.inf)
    for first, second in itertools.combinations(range(len(cameras)), 2):
        points = _nearest_point(origins[[first, second]], directions[:, [first, second]])
        cost = np.minimum(_misses(points, centers, sides, cameras), 1).sum(axis=1)
        better = np.isfinite(points[:, 0]) & (cost < best_cost)
        best[better], best_cost[better] = points[better], cost[better]
    agrees = _misses(best, centers, sides, cameras) < _HEAD_MOST_MISS
    agrees[agrees.sum(axis=1) < 2] = False
    return HeadPath(triangulate(centers[:, :, None], agrees, cameras)[:, 0], agrees)


def triangulate(
    pixels: Float[np.ndarray, "t c p 2"], agrees: Bool[np.ndarray, "t c"], cameras: Sequence[Camera]
) -> Float[np.ndarray, "t p 3"]:
    """Return the points nearest to the rays of the cameras that agree; NaN where there are no such cameras.

    They have the least sum of squared distances to these rays.
    """
    directions = np.stack([rays_of(pixels[:, :, index], cameras) for index in range(pixels.shape[2])], axis=2)
    origins = np.stack([camera.position.numpy() for camera in cameras]).astype(np.float64)
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    across = np.where(agrees[:, :, None, None, None], across, 0)
    summed = across.sum(axis=1)
    summed[~agrees.any(axis=1)] = np.nan
    return np.linalg.solve(summed, np.einsum("tcpij,cj->tpi", across, origins)[..., None])[..., 0]


def _sides(boxes: Float[np.ndarray, "t c 4"]) -> Float[np.ndarray, "t c"]:
    return np.sqrt(np.prod(boxes[..., 2:] - boxes[..., :2], axis=-1))


def choose_crops(
    path: HeadPath, cameras: Sequence[Camera], size: int, whole: bool
) -> tuple[list[Crop], tuple[int, int]]:
    """Choose a fixed crop for every camera, all of one width and height (which are returned) and of one scale.

    `size` is their largest side in pixels; the smallest crop limits it, since none is enlarged. Whole pictures are also
    taken if all of them are head crops already.
    """
    spans = [_span(path, camera) for camera in cameras]
    sides = [max(span[2] - span[0], span[3] - span[1]) for span in spans]
    is_head = all(
        max(camera.width, camera.height) <= CROP_MOST_ASPECT * min(camera.width, camera.height)
        and side >= CROP_LEAST_HEAD_SHARE * min(camera.width, camera.height)
        for camera, side in zip(cameras, sides, strict=True)
    )
    shapes = {(camera.width, camera.height) for camera in cameras}
    if whole or (is_head and len(shapes) == 1):
        if len(shapes) > 1:
            raise UserError(
                f"--capture.crop none: the cameras' pictures have {len(shapes)} different sizes, and a capture has "
                "one; leave the option out, so that each is cropped to the head"
            )
        width, height = shapes.pop()
        crop = whole_picture(width, height, size)
        return [crop] * len(cameras), (crop.width, crop.height)
    cuts = [min(round(side), camera.width, camera.height) for side, camera in zip(sides, cameras, strict=True)]
    output = min(size, *cuts)
    crops = [
        crop_around(span, cut, camera.width, camera.height, output)
        for span, cut, camera in zip(spans, cuts, cameras, strict=True)
    ]
    return crops, (output, output)


def disagreeing(path: HeadPath, boxes: Float[np.ndarray, "t c 4"], cameras: Sequence[Camera]) -> dict[int, float]:
    """Return the cameras that mostly find the face where the others do not see it, with the median distance in pixels.

    Cameras that find a face in less than half of the timesteps are left out: they look at the back of the head.
    """
    found = np.isfinite(boxes[..., 0]) & path.known[:, None]
    centers = (boxes[..., :2] + boxes[..., 2:]) / 2
    result = {}
    for index, camera in enumerate(cameras):
        seen = found[:, index]
        if seen.sum() < 0.5 * path.known.sum() or path.agrees[seen, index].mean() >= 0.5:
            continue
        distances = np.linalg.norm(project(path.centers[seen], camera) - centers[seen, index], axis=-1)
        result[index] = float(np.median(distances))  # NaN if the head is behind the camera
    return result


def rays_of(pixels: Float[np.ndarray, "t c 2"], cameras: Sequence[Camera]) -> Float[np.ndarray, "t c 3"]:
    """Directions in world space, of unit length, through pixels of each camera."""
    homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1)
    rays = []
    for index, camera in enumerate(cameras):
        to_world = (np.linalg.inv(camera.K.numpy().astype(np.float64)).T) @ camera.viewmat[:3, :3].numpy()
        rays.append(homogeneous[:, index] @ to_world)
    stacked = np.stack(rays, axis=1)
    return stacked / np.linalg.norm(stacked, axis=-1, keepdims=True)


def _nearest_point(
    origins: Float[np.ndarray, "2 3"], directions: Float[np.ndarray, "t 2 3"]
) -> Float[np.ndarray, "t 3"]:
    """The middle between two rays where they come closest; NaN if they are nearly parallel or meet behind a camera."""
    first, second = directions[:, 0], directions[:, 1]
    cosine, between = (first * second).sum(axis=-1), origins[1] - origins[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        sine2 = 1 - cosine**2
        along_first = ((first @ between) - cosine * (second @ between)) / sine2
        along_second = (cosine * (first @ between) - (second @ between)) / sine2
        usable = (sine2 > _HEAD_LEAST_ANGLE**2) & (along_first > 0) & (along_second > 0)
    points = (origins[0] + along_first[:, None] * first + origins[1] + along_second[:, None] * second) / 2
    return np.where(usable[:, None], points, np.nan)


def _misses(
    points: Float[np.ndarray, "t 3"], centers: Float[np.ndarray, "t c 2"], sides: Float[np.ndarray, "t c"],
    cameras: Sequence[Camera],
) -> Float[np.ndarray, "t c"]:  # fmt: skip
    projected = np.stack([project(points, camera) for camera in cameras], axis=1)
    with np.errstate(invalid="ignore"):
        misses = np.linalg.norm(projected - centers, axis=-1) / sides
    return np.where(np.isfinite(misses), misses, np.inf)


def project(points: Float[np.ndarray, "*n 3"], camera: Camera) -> Float[np.ndarray, "*n 2"]:
    """Pixels of points in world space; NaN behind the camera."""
    inside = points @ camera.viewmat[:3, :3].numpy().T.astype(np.float64) + camera.viewmat[:3, 3].numpy()
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = (inside @ camera.K.numpy().T)[..., :2] / inside[..., 2:]
        return np.where(inside[..., 2:] > 0, pixels, np.nan)


def _span(path: HeadPath, camera: Camera) -> Float[np.ndarray, " 4"]:
    """Left, top, right, bottom in pixels of the head's sphere over the whole path."""
    centers = path.centers[path.known]
    depth = (centers @ camera.viewmat[2, :3].numpy().astype(np.float64)) + float(camera.viewmat[2, 3])
    radius = _HEAD_RADIUS * np.array([[float(camera.K[0, 0]), float(camera.K[1, 1])]]) / depth[:, None]
    middle = project(centers, camera)
    if not np.isfinite(middle).all():
        raise UserError("--calibration: the head is behind a camera; check that matrices go from world to camera")
    least = np.percentile(middle - radius, CROP_OUTLIERS, axis=0)
    return np.concatenate([least, np.percentile(middle + radius, 100 - CROP_OUTLIERS, axis=0)])


def _check_unit(
    path: HeadPath, sides: Float[np.ndarray, "t c"], cameras: Sequence[Camera], advise: Callable[[], str]
) -> None:
    widths = []
    for index, camera in enumerate(cameras):
        chosen = path.agrees[:, index]
        depth = path.centers[chosen] @ camera.viewmat[2, :3].numpy() + float(camera.viewmat[2, 3])
        widths.append(sides[chosen, index] * depth / float(camera.K[0, 0]))
    width = float(np.median(np.concatenate(widths)))
    if not 0.08 <= width <= 0.35:  # metres, from eyebrows to chin as the detector's boxes go
        meters = f"give positions in metres (multiply the last column of every viewmat by {0.15 / width:.3g})"
        raise UserError(
            f"--calibration: according to these cameras the face is {width:.3g} m wide, but it should be about 0.15; "
            + (advise() or meters)
        )
