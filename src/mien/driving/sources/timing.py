"""Tracked sequences at evenly spaced moments: each frame of a video keeps its own time."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.capture.capture import Capture
from mien.driving.motion import check_times
from mien.face.params import FaceParams
from mien.media.pace import frame_rate, is_pause
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle


@dataclass(frozen=True, eq=False)
class Moments:
    """Evenly spaced moments, each between two frames of a sequence."""

    before: Int[np.ndarray, " m"]
    """Index of the frame before each moment, or at it. It is never the last one."""
    share: Float[np.ndarray, " m"]
    """Part of the way to the next frame, 0..1."""

    def nearest(self) -> Int[np.ndarray, " m"]:
        """Index of the frame that is shown at each moment."""
        return self.before + (self.share > 0.5)


def rate_of(capture: Capture) -> float:
    """The frame rate of a capture, without its pauses."""
    return frame_rate(capture.timestamps - capture.timestamps[:1], capture.fps)


def even_moments(capture: Capture, fps: float) -> Moments | None:
    """Moments of a sequence at a rate, or None if its frames are evenly spaced at this rate already.

    In a pause, the face is held until the last moment before the next frame, as a player holds the picture.
    """
    seconds = capture.timestamps - capture.timestamps[:1]
    if len(seconds) < 2 or seconds[-1] <= 0:
        return None
    even = np.arange(round(seconds[-1] * fps) + 1) / fps
    if len(even) == len(seconds) and np.abs(even - seconds).max() < 0.5 / fps:
        return None
    check_times(seconds, lambda index: f"{capture.name}, frame {index}")
    before = np.clip(np.searchsorted(seconds, even + 1e-9, side="right") - 1, 0, len(seconds) - 2)
    steps = np.diff(seconds)
    since = np.where(is_pause(steps)[before], seconds[before + 1] - 1 / fps, seconds[before])
    share = (even - since) / np.maximum(seconds[before + 1] - since, 1e-9)
    return Moments(before, np.clip(share, 0, 1))


def at_moments(face: FaceParams, moments: Moments) -> FaceParams:
    """The face at the moments: numbers change linearly from frame to frame, and rotations along the shortest way."""
    earlier, later = face[moments.before.tolist()], face[(moments.before + 1).tolist()]
    share = torch.from_numpy(moments.share).to(face.expression)[:, None]
    return replace(
        earlier,
        expression=torch.lerp(earlier.expression, later.expression, share),
        joints=_turned(earlier.joints, later.joints, share[:, None]),
        head_rotation=_turned(earlier.head_rotation, later.head_rotation, share),
        head_translation=torch.lerp(earlier.head_translation, later.head_translation, share),
    )


def _turned(
    earlier: Float[Tensor, "m *j 3"], later: Float[Tensor, "m *j 3"], share: Float[Tensor, "m *#j 1"]
) -> Float[Tensor, "m *j 3"]:
    start = matrix_from_axis_angle(earlier)
    way = axis_angle_from_matrix(start.transpose(-1, -2) @ matrix_from_axis_angle(later))
    return axis_angle_from_matrix(start @ matrix_from_axis_angle(share * way))
