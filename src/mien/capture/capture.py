"""Capture: frames, mattes and landmarks of one sequence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.camera import Camera
from mien.capture.quality import FrameQuality


@dataclass(frozen=True, eq=False)
class Capture:
    """t timesteps seen by c cameras. Read from disk, `images` and `mattes` are memory maps."""

    name: str
    """Of the sequence."""
    camera_ids: tuple[str, ...]
    fps: float
    """Frames a second."""
    timestamps: Float[np.ndarray, " t"]
    """Seconds from the start."""
    images: UInt8[np.ndarray, "t c h w 3"]
    """sRGB as decoded."""
    mattes: UInt8[np.ndarray, "t c h w"]
    """Foreground opacity, 255 = person."""
    landmarks: Float[np.ndarray, "t c l 2"]
    """MediaPipe's 478 points in pixels; NaN where no face was found."""
    valid: Bool[np.ndarray, "t c"]
    """False: no face was found; trackers and trainers leave the frame out."""
    principal_point: Float[np.ndarray, "c 2"]
    """Where the source picture's centre lies, in pixels (a crop may move it off the centre)."""
    source: dict
    """Where it came from: file name, content hash, crop box, original size."""
    calibration: tuple[Camera, ...] | None = None
    """One calibrated camera a camera_id, in one world frame, for pictures of this size; None where it is unknown."""
    quality: FrameQuality | None = None
    """How sharp and how well lit the face is; None where it was not measured."""

    @property
    def usable(self) -> Bool[np.ndarray, "t c"]:
        """Frames fit to learn from: a face was found, and it is not blurred."""
        return self.valid if self.quality is None else self.valid & ~self.quality.blurred

    @property
    def timesteps(self) -> int:
        """The number of timesteps, t."""
        return self.images.shape[0]

    @property
    def width(self) -> int:
        """Pixels."""
        return self.images.shape[3]

    @property
    def height(self) -> int:
        """Pixels."""
        return self.images.shape[2]
