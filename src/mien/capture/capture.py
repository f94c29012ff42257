"""Capture: frames, mattes and landmarks of one sequence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.camera import Camera
from mien.capture.quality import FrameQuality


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of t timesteps seen by c cameras. If it was read from disk, `images` and `mattes` are memory maps."""

    name: str
    """Name of the sequence."""
    camera_ids: tuple[str, ...]
    fps: float
    """Frames per second."""
    timestamps: Float[np.ndarray, " t"]
    """Time of each frame in seconds from the start."""
    images: UInt8[np.ndarray, "t c h w 3"]
    """Decoded sRGB pixels."""
    mattes: UInt8[np.ndarray, "t c h w"]
    """Foreground opacity, 255 = person."""
    landmarks: Float[np.ndarray, "t c l 2"]
    """MediaPipe's 478 points in pixels. NaN where no face was found."""
    valid: Bool[np.ndarray, "t c"]
    """Whether a face was found. Trackers and trainers skip the other frames."""
    principal_point: Float[np.ndarray, "c 2"]
    """Position of the source picture's centre in pixels. A crop may move it away from the frame's centre."""
    source: dict
    """Origin of the capture: file name, content hash, crop box, original size."""
    calibration: tuple[Camera, ...] | None = None
    """One calibrated camera per camera_id, in one world frame, for frames of this size. None if unknown."""
    quality: FrameQuality | None = None
    """Sharpness and lighting of the face. None if they were not measured."""

    @property
    def usable(self) -> Bool[np.ndarray, "t c"]:
        """Frames to learn from: a face was found in them, and it is not blurred."""
        return self.valid if self.quality is None else self.valid & ~self.quality.blurred

    @property
    def timesteps(self) -> int:
        """The number of timesteps, t."""
        return self.images.shape[0]

    @property
    def width(self) -> int:
        """Width of the frames in pixels."""
        return self.images.shape[3]

    @property
    def height(self) -> int:
        """Height of the frames in pixels."""
        return self.images.shape[2]
