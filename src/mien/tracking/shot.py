"""A capture as tracking sees it: detected landmarks, cameras as far as they are known, and a frame to fit in."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.errors import UserError
from mien.rotation import invert_rigid
from mien.tracking.flicker import without_flicker
from mien.tracking.settings import TrackingSettings
from mien.tracking.views import CameraBatch, Views, batch_of

_LEAST_FRAMES = 3
_DEFAULT_FOCAL = 1.5
"""Times the larger side of the source picture: between a telephone's wide lens and a portrait lens."""
_CROPPED_FOCAL = 2.2
"""The same of a picture that is about square: no camera films squares, so that it was cut around a head."""
_SQUARE = 1.1
"""Ratio of sides below which a picture counts as square."""
_FACING = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""T_camera_head of a head at the camera's centre that looks the way the camera is seen."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One sequence's input to a fit."""

    views: Views
    valid: Bool[Tensor, " t"]
    """Timesteps in which some camera found a face: the rows of `views`."""
    cameras: CameraBatch
    """In the frame of the fit, in which a head that looks into the camera that saw it most has a rotation of about
    zero: rotation vectors stay far from a half turn, whatever the calibration's world is."""
    fps: float
    capture: Capture
    T_world_fit: Float[Tensor, "4 4"] | None
    """Where the cameras are calibrated; None where the frame of the fit is the world's."""

    def cameras_in_world(self, fitted: CameraBatch) -> tuple[Camera, ...]:
        """The cameras as a tracking holds them: the calibrated ones, or with the fitted focal length."""
        if self.capture.calibration is not None:
            return self.capture.calibration
        like, size = torch.zeros(()), (self.capture.width, self.capture.height)
        pairs = zip(fitted.K, fitted.viewmat, strict=True)
        return tuple(Camera(K, viewmat, *size).to(like) for K, viewmat in pairs)


def has_enough_faces(capture: Capture) -> bool:
    """Whether a face was found often enough for tracking."""
    return int(_seen(capture).any(1).sum()) >= _LEAST_FRAMES


def shot_of(capture: Capture, settings: TrackingSettings) -> Shot:
    """What there is to fit to.

    Raises:
        UserError: several cameras without calibration, or too few timesteps with a face.
    """
    cameras = len(capture.camera_ids)
    if cameras != 1 and capture.calibration is None:
        raise UserError(
            f"{capture.name}: has {cameras} cameras without calibration; capture each video on its own "
            "(`mien create A.mp4 B.mp4`), or give the cameras' calibration"
        )
    detected = torch.from_numpy(np.asarray(capture.landmarks, dtype=np.float64))
    seen = _seen(capture)
    valid = seen.any(1)
    found = int(valid.sum())
    if found < _LEAST_FRAMES:
        raise UserError(
            f"{capture.name}: a face was found in {found} frames, tracking needs {_LEAST_FRAMES}; film longer"
        )
    detected = without_flicker(detected, seen)
    row, camera = seen[valid].nonzero().unbind(1)
    views = Views(detected[valid][row, camera], row, camera, torch.ones(len(row), dtype=torch.float64))
    if capture.calibration is None:
        batch, T_world_fit = batch_of((initial_camera(capture, settings),)), None
    else:
        batch = batch_of(capture.calibration)
        T_world_fit = invert_rigid(batch.viewmat[int(seen.sum(0).argmax())]) @ _FACING
        batch = CameraBatch(batch.K, batch.viewmat @ T_world_fit)
    return Shot(views, valid, batch, capture.fps, capture, T_world_fit)


def _seen(capture: Capture) -> Bool[Tensor, "t c"]:
    """In which pictures a face was found."""
    finite = np.isfinite(np.asarray(capture.landmarks)).all((-1, -2))
    return torch.from_numpy(np.asarray(capture.valid, dtype=bool) & finite)


def lenses_of(captures: Sequence[Capture], settings: TrackingSettings) -> list[int | None]:
    """For each capture, the number of the unknown focal length that it has; None where that is known."""
    lenses: list[int | None] = []
    free = 0
    for capture in captures:
        if capture.calibration is not None or settings.focal is not None:
            lenses.append(None)
        else:
            lenses.append(0 if settings.same_camera else free)
            free += 1
    return lenses


def initial_camera(capture: Capture, settings: TrackingSettings) -> Camera:
    """The camera of the captured pictures, float64, with a given or assumed focal length."""
    focal_x, focal_y = _source_focal(capture) if settings.focal is None else (settings.focal, settings.focal)
    x, y = (float(value) for value in capture.principal_point[0])
    K = torch.tensor([[focal_x, 0, x], [0, focal_y, y], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, _FACING.clone(), capture.width, capture.height)


def _source_focal(capture: Capture) -> tuple[float, float]:
    """The assumed focal lengths along x and y in pixels of the capture: it may be a shrunk crop of what was filmed."""
    crop = capture.source.get("crop", {"width": capture.width, "height": capture.height})
    sides = capture.source.get("picture_size", (crop["width"], crop["height"]))
    assumed = (_CROPPED_FOCAL if max(sides) < _SQUARE * min(sides) else _DEFAULT_FOCAL) * float(max(sides))
    return assumed * capture.width / crop["width"], assumed * capture.height / crop["height"]
