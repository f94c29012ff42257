"""An import is compared with its pictures, because no file names its version of FLAME or its conventions.

The drawn head must lie on the person, and its landmarks where the detector sees them. Both come from the pictures
alone, so that a misread convention cannot hide in them. A face model of another version passes both, because it is a
head as well. It is found by the colours of the skin: on the right model, a point of the mesh lies on the same skin in
every frame, and has the same colour. Coefficients of another version move the mesh in other ways than the face moves:
it then holds to the skin worse than the mean head, or than the face at rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from mien.camera import Camera
from mien.capture.person.faces import LandmarkDetector
from mien.datasets.dataset import TrackedSequence
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.render.mesh import rasterize_mesh

_FRAMES, _CAMERAS = 5, 3
_SOLID = 128
_MIN_INSIDE = 0.7
"""Least share of the drawn head that lies on the person. Right imports have more than 0.9, even without hair. Other
identities have that as well: only misread cameras and poses have less."""
_MAX_DISTANCE = 0.15
"""Largest median distance of landmarks from those that the detector finds, over the distance of the outer corners of
the eyes. A fitted FLAME has about 0.03 to 0.05; drawings have 0.09, because the detector is less exact in them. Another
basis of identities or expressions changes that by 0.01 at most: only misread cameras and poses have more."""
_CORNERS = (33, 263)  # MediaPipe's points at the outer corners of the eyes
_MAX_SPREAD = 1.12
"""Largest spread of the skin's colours, over that without identity or without expressions. Chosen on 200
drawn right trackings, with hard light, noise, jpg and poses that are off by 3 pixels: they had at most 1.10. Of 70
others, none had more than 1.03."""
_OTHER_SIZE = 1.3  # least ratio of the sizes of pictures and of the camera that is told
_LANDMARKS, _SKIN = "mediapipe", 468  # the points that are compared, and the number of those that are not on the irises
_SKIN_FRAMES, _SKIN_CAMERAS = 24, 3  # most frames and cameras that are compared
_MIN_FRAMES = 8
_EYES, _MIN_EYES = 100.0, 15.0
"""Distance of the outer corners of the eyes, in pixels, to which larger pictures are shrunk, and the smallest one that
is compared."""
_BLUR = 0.025  # sigma of the blur of pictures, over that distance
_SHIFTS = (-0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03)
"""Shifts of a whole face along each axis of the picture, over that distance, that a tracking may be off in a frame."""
_ROUNDS = 3  # number of times that the median colours and the shift of each frame are found by turns
_FACING = 0.3  # least cosine between the normal at a point and the direction to the camera
_MIN_MOTIONS = (0.006, 0.014)
"""Least motion by identity and by expressions that is compared: root mean square of points, over that distance. In
drawings, the noise of a tracking moves a face that is still by up to 0.012."""


@dataclass(frozen=True)
class Overlay:
    """How a tracking fits its pictures."""

    inside: float
    """Share of the drawn head's pixels that lie on the person, 0..1."""
    agreement: float
    """Intersection of the drawn head and the person, over their union, 0..1."""
    distance: float | None
    """Median distance of landmarks from the detector's, relative to the distance of the eyes' outer corners. None if
    the detector finds no face."""


@torch.no_grad()
def measure_overlay(sequence: TrackedSequence) -> Overlay:
    """Compare a tracking with some of its pictures."""
    capture, model = sequence.capture, sequence.face_model
    timesteps, cameras = spread_out(capture.timesteps, _FRAMES), spread_out(len(capture.camera_ids), _CAMERAS)
    vertices = model(sequence.tracking.face[timesteps])
    faces = model.faces[~model.region_mask(*({"neck"} & set(model.region_names)))]
    drawn, inside, either, distances = 0, 0, 0, []
    with LandmarkDetector(several_faces=False) as detector:
        for index, timestep in enumerate(timesteps):
            for camera in cameras:
                view = sequence.tracking.cameras[camera]
                covered = (rasterize_mesh(vertices[index], faces, view).face_index >= 0).numpy()
                drawn += int(covered.sum())
                solid = capture.mattes[timestep, camera] >= _SOLID
                inside += int((covered & solid).sum())
                either += int((covered | solid).sum())
                found = detector.detect(np.ascontiguousarray(capture.images[timestep, camera]))
                own = capture.landmarks[timestep, camera]
                eyes = np.linalg.norm(own[_CORNERS[0]] - own[_CORNERS[1]])
                if len(found) and eyes > 1:
                    distances.append(float(np.median(np.linalg.norm(found[0] - own, axis=-1)) / eyes))
    return Overlay(inside / max(drawn, 1), inside / max(either, 1), float(np.median(distances)) if distances else None)


def check_overlay(path: Path, sequence: TrackedSequence, version: str) -> TrackedSequence:
    """Return the sequence, after a check that its tracking fits its pictures, and its face model its tracking."""
    overlay, name = measure_overlay(sequence), sequence.capture.name
    if overlay.inside < _MIN_INSIDE:
        raise UserError(
            f"{path}: only {overlay.inside:.0%} of the tracked head lies on the person in {name}, so tracking and "
            f"pictures do not fit{_sizes(sequence)}; copy the files again, or give another --face-model (it needs "
            f"{version})"
        )
    if overlay.distance is not None and overlay.distance > _MAX_DISTANCE:
        raise UserError(
            f"{path}: in {name}, landmarks of the tracking are {overlay.distance:.0%} of the distance of the eyes "
            f"beside those in the pictures{_sizes(sequence)}; its tracking needs {version}: give that with "
            "--face-model, or track the pictures again (--retrack)"
        )
    check_version(path, sequence, version)
    return sequence


def check_version(path: Path, sequence: TrackedSequence, version: str) -> None:
    """Check that coefficients of the tracking move the face model as the face in the pictures moves."""
    steadiness = measure_steadiness(sequence)
    for spread, what in ((steadiness.identity, "identity"), (steadiness.expression, "expressions")):
        if spread is not None and spread > _MAX_SPREAD:
            raise UserError(
                f"{path}: in {sequence.capture.name}, the skin's colours spread {spread - 1:.0%} more with the "
                f"tracking's {what} on {sequence.face_model.name!r} than without, so this is another version of the "
                f"model; it needs {version}: give that, or whichever of FLAME 2020, FLAME 2023 and FLAME 2023 Open "
                "the authors used, with --face-model, or track the pictures again (--retrack)"
            )


def _sizes(sequence: TrackedSequence) -> str:
    """Return in words that the pictures have another size than the tracking's, by the centre of its camera."""
    view = sequence.tracking.cameras[0]
    width, height = (2 * float(center) for center in view.K[:2, 2])
    ratios = sorted((view.width / max(width, 1e-6), view.height / max(height, 1e-6)))
    if not (ratios[0] > _OTHER_SIZE or ratios[1] < 1 / _OTHER_SIZE):
        return ""
    return (
        f": these have {view.width}x{view.height} pixels, and the tracking was made on about {width:.0f}x{height:.0f}, "
        "so give pictures of that size"
    )


@dataclass(frozen=True)
class Steadiness:
    """Spread of the skin's colours over the frames, as a share of the spread without some coefficients.

    A right model has less than 1, because its coefficients make the mesh follow the face. None stands for a comparison
    that says nothing: there are few frames, or the face is small, or the coefficients hardly move it, or the model
    has no such points.
    """

    identity: float | None
    expression: float | None


_Seen = tuple[Float[np.ndarray, "t l 2"], Bool[np.ndarray, "t l"]]
"""Points of one camera in t frames, in pixels, and which of them face it."""
_Deviation = tuple[Float[np.ndarray, " p"], Float[np.ndarray, "2 p"], Float[np.ndarray, "2 p"]]
"""How far points are from their own median colour, with all coefficients and without those of identity or expression,
and how far these coefficients move them."""


@torch.no_grad()
def measure_steadiness(sequence: TrackedSequence) -> Steadiness:
    """Compare the spread of the skin's colours with that of the mean head, and of the face without expressions."""
    capture, face = sequence.capture, sequence.tracking.face
    timesteps = spread_out(capture.timesteps, _SKIN_FRAMES)
    if len(timesteps) < _MIN_FRAMES or _LANDMARKS not in sequence.face_model.landmarks:
        return Steadiness(None, None)
    some = face[timesteps]
    rests = (
        replace(some, identity=torch.zeros_like(some.identity)),
        replace(some, expression=torch.zeros_like(some.expression)),
    )
    parts = []
    for camera in spread_out(len(capture.camera_ids), _SKIN_CAMERAS):
        view = sequence.tracking.cameras[camera]
        own, *others = (_seen(sequence.face_model, each, view) for each in (some, *rests))
        found = _deviations([capture.images[timestep, camera] for timestep in timesteps], own, others)
        if found is not None:
            parts.append(found)
    return Steadiness(_share(parts, 0), _share(parts, 1))


def spread_out(count: int, most: int) -> list[int]:
    """Return at most so many indices, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(int)).tolist()


def _seen(model: FaceModel, face: FaceParams, view: Camera) -> _Seen:
    marks = model.landmarks[_LANDMARKS]
    corners = model(face)[:, model.faces[marks.faces[:_SKIN]]]
    points = (corners * marks.barycentric[:_SKIN, :, None]).sum(2)
    normals = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    place = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    cosines = torch.nn.functional.cosine_similarity(normals, place - points, dim=-1)
    return view.project(points)[0].double().numpy(), (cosines > _FACING).numpy()


def _deviations(images: list[UInt8[np.ndarray, "h w 3"]], own: _Seen, others: list[_Seen]) -> _Deviation | None:
    """Return what one camera shows of the face, at the points that face it. None if that is too small."""
    facing = own[1] & (own[1].sum(0) >= max(_MIN_FRAMES, len(images)) // 2)
    pixels = [each[0] for each in (own, *others)]
    eyes = float(np.linalg.norm(pixels[0][:, _CORNERS[0]] - pixels[0][:, _CORNERS[1]], axis=-1).mean())
    if (
        not _MIN_EYES <= eyes <= max(images[0].shape)
        or not facing.any()
        or not all(np.isfinite(each).all() for each in pixels)
    ):
        return None
    spreads = [_spread(each, facing) for each in _colors(images, pixels, eyes)]
    shifts = [each - pixels[0] for each in pixels[1:]]
    motions = [np.linalg.norm(each - _over_frames(np.nanmean, each, facing), axis=-1)[facing] / eyes for each in shifts]
    return spreads[0], np.stack(spreads[1:]), np.stack(motions)


def _spread(colours: Float[np.ndarray, "t s l 3"], facing: Bool[np.ndarray, "t l"]) -> Float[np.ndarray, " p"]:
    """Return distances from the median colour over the frames, each frame at the shift at which it fits best."""
    best = colours[:, colours.shape[1] // 2]
    for _ in range(_ROUNDS):
        apart = np.linalg.norm(colours - _over_frames(np.nanmedian, best, facing), axis=-1)
        chosen = np.where(facing[:, None], apart**2, 0).sum(2).argmin(1)
        best = colours[np.arange(len(colours)), chosen]
    return np.linalg.norm(best - _over_frames(np.nanmedian, best, facing), axis=-1)[facing]


def _over_frames(
    mean: Callable[..., np.ndarray], values: Float[np.ndarray, "t l c"], facing: Bool[np.ndarray, "t l"]
) -> Float[np.ndarray, "l c"]:
    seen = facing.any(0)
    result = np.zeros(values.shape[1:])
    result[seen] = mean(np.where(facing[:, seen, None], values[:, seen], np.nan), axis=0)
    return result


def _colors(
    images: list[UInt8[np.ndarray, "h w 3"]], pixels: list[Float[np.ndarray, "t l 2"]], eyes: float
) -> list[Float[np.ndarray, "t s l 3"]]:
    """Return the blurred colours of pictures at each set of points, for each shift of `_SHIFTS`."""
    shrink = min(1.0, _EYES / eyes)
    offsets = np.stack(np.meshgrid(_SHIFTS, _SHIFTS), axis=-1).reshape(-1, 1, 2) * eyes
    found: list[list[np.ndarray]] = [[] for _ in pixels]
    for timestep, image in enumerate(images):
        height, width = image.shape[:2]
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if shrink < 1 else image
        blurred = cv2.GaussianBlur(small.astype(np.float32), (0, 0), _BLUR * eyes * shrink)
        for each, points in zip(found, pixels, strict=True):
            places = (points[timestep] + offsets) * np.divide(size, (width, height)) - 0.5
            places = places.clip(-1, size).astype(np.float32)
            x, y = places[..., 0], places[..., 1]
            each.append(cv2.remap(blurred, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE))
    return [np.stack(each).astype(np.float64) for each in found]


def _share(parts: list[_Deviation], index: int) -> float | None:
    """Return the spread of colours over that without some coefficients: by squares or lengths, whichever is smaller."""
    if not parts:
        return None
    own = np.concatenate([each[0] for each in parts])
    other, motion = (np.concatenate([each[place][index] for each in parts]) for place in (1, 2))
    if not np.sqrt((motion**2).mean()) >= _MIN_MOTIONS[index] or not other.mean() > 0:
        return None
    return float(min(np.sqrt((own**2).mean() / (other**2).mean()), own.mean() / other.mean()))
