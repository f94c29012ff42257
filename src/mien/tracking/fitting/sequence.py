"""A capture as input of a fit: detected landmarks without flicker, known or assumed cameras, the frame of the fit."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_opening
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.errors import UserError
from mien.machine.terminal import counted
from mien.rotation import invert_rigid
from mien.tracking.fitting.views import CameraBatch, Views, batch_of
from mien.tracking.settings import TrackingSettings

FOCAL = 1.5  # focal length of an unknown camera, in larger sides of the source picture
_CROPPED_FOCAL = 2.2
"""The same for a nearly square picture. No camera films squares, so the picture was cropped around a head. Measured
against 1.5: d3 gains 0.3 dB, and wojtek nothing (log, "Focal length")."""
_SQUARE = 1.1  # ratio of sides below which a picture counts as square
_SWING = 0.3
"""Largest ratio of squared motion over two frames to the sum of both squared single-frame motions that counts as a
swing. The ratio is 0 for a swing, 0.5 for noise and 2 for steady motion."""
_SWING_FRAMES = 4
"""Fewest frames in a row that swing. A blink is a single swing and is kept. Measured against no averaging: the jitter
of beard falls from 0.104 to 0.055 mm, and footage does not change (log, "The landmark detector")."""

_MIN_FRAMES = 3
FACING = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""T_camera_head of a head that looks towards the camera, but is placed at the camera's centre."""


@dataclass(frozen=True, eq=False)
class SequenceData:
    """The input of one sequence to a fit."""

    views: Views
    valid: Bool[Tensor, " t"]
    """Timesteps in which at least one camera found a face. They are the rows of `views`."""
    cameras: CameraBatch
    """Cameras in the frame of the fit. In this frame a head that looks into the camera that found most faces has a
    rotation of about zero, so axis-angle rotations stay far from half a turn in any calibrated world."""
    capture: Capture
    T_world_fit: Float[Tensor, "4 4"] | None
    """Transform from the frame of the fit to the calibrated world; None if they are the same."""

    @property
    def timesteps(self) -> Int[Tensor, " v"]:
        """The timesteps with a face."""
        return self.valid.nonzero()[:, 0]


def has_enough_faces(capture: Capture) -> bool:
    """Whether a face was found often enough for tracking."""
    return int(_seen(capture).any(1).sum()) >= _MIN_FRAMES


def sequence_data(capture: Capture, settings: TrackingSettings) -> SequenceData:
    """Make the input of a fit from a capture."""
    cameras = len(capture.camera_ids)
    if cameras != 1 and capture.calibration is None:
        raise UserError(
            f"{capture.name}: has {cameras} cameras without calibration; capture each video on its own "
            "(`mien create A.mp4 B.mp4`), or all with their calibration (`mien capture A.mp4 B.mp4 --calibration FILE`)"
        )
    detected = torch.from_numpy(np.asarray(capture.landmarks, dtype=np.float64))
    seen = _seen(capture)
    valid = seen.any(1)
    if not has_enough_faces(capture):
        frames = counted(int(valid.sum()), "frame")
        raise UserError(f"{capture.name}: a face was found in {frames}, but tracking needs {_MIN_FRAMES}; film longer")
    detected = without_flicker(detected, seen)
    row, camera = seen[valid].nonzero().unbind(1)
    views = Views(detected[valid][row, camera], row, camera, torch.ones(len(row), dtype=torch.float64))
    if capture.calibration is None:
        batch, T_world_fit = batch_of((initial_camera(capture, settings),)), None
    else:
        batch = batch_of(capture.calibration)
        T_world_fit = invert_rigid(batch.viewmat[int(seen.sum(0).argmax())]) @ FACING
        batch = CameraBatch(batch.K, batch.viewmat @ T_world_fit)
    return SequenceData(views, valid, batch, capture, T_world_fit)


@contextmanager
def explaining_singular(sequences: Sequence[SequenceData]) -> Iterator[None]:
    """Turn equations of landmarks that have no solution into an error that names the sequences."""
    try:
        yield
    except torch.linalg.LinAlgError:
        names = ", ".join(data.capture.name for data in sequences)
        raise UserError(
            f"{names}: no face fits the landmarks; check the pictures, then capture the video again"
        ) from None


def _seen(capture: Capture) -> Bool[Tensor, "t c"]:
    """The pictures in which a face was found."""
    finite = np.isfinite(np.asarray(capture.landmarks)).all((-1, -2))
    return torch.from_numpy(np.asarray(capture.valid, dtype=bool) & finite)


def initial_camera(capture: Capture, settings: TrackingSettings) -> Camera:
    """The camera of the captured pictures in float64, with the given focal length or one assumed for the source."""
    crop = capture.source.get("crop", {"width": capture.width, "height": capture.height})
    sides = capture.source.get("picture_size", (crop["width"], crop["height"]))
    assumed = (_CROPPED_FOCAL if max(sides) < _SQUARE * min(sides) else FOCAL) * float(max(sides))
    focal = assumed * capture.width / crop["width"], assumed * capture.height / crop["height"]
    focal_x, focal_y = focal if settings.focal is None else (settings.focal, settings.focal)
    x, y = (float(value) for value in capture.principal_point[0])
    K = torch.tensor([[focal_x, 0, x], [0, focal_y, y], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, FACING.clone(), capture.width, capture.height)


def without_flicker(landmarks: Float[Tensor, "t c l 2"], seen: Bool[Tensor, "t c"]) -> Float[Tensor, "t c l 2"]:
    """Return the landmarks, with the mean of both answers wherever they swing for several frames.

    A detector that crops each picture by its last answer can swing between two answers. If nothing moves, the crop of
    the next picture depends on the last answer and the answer on the crop, so landmarks may go to and fro for ever. No
    part of a face does that: none moves up in one frame and down in the next, again and again. Landmarks may have any
    value where a camera has not `seen` a face.
    """
    if len(landmarks) < _SWING_FRAMES + 2:
        return landmarks
    steps = (landmarks[1:] - landmarks[:-1]).square().sum((-1, -2))
    across = (landmarks[2:] - landmarks[:-2]).square().sum((-1, -2))
    swings = torch.zeros_like(seen)
    swings[1:-1] = across < _SWING * (steps[1:] + steps[:-1])  # False for NaN
    swings[1:-1] &= seen[:-2] & seen[1:-1] & seen[2:]
    runs = torch.from_numpy(binary_opening(swings.numpy(), np.ones((_SWING_FRAMES, 1), bool)))
    # The frames at both ends of a run swing too, but with only one of their neighbours.
    linked = (runs[:-1] | runs[1:])[..., None, None]
    forward = torch.where(linked, landmarks[1:] - landmarks[:-1], 0.0)
    towards, neighbors = torch.zeros_like(landmarks), torch.zeros_like(landmarks[:, :, :1, :1])
    towards[:-1] += forward
    towards[1:] -= forward
    neighbors[:-1] += linked
    neighbors[1:] += linked
    return landmarks + towards / (2 * neighbors.clamp_min(1))
