"""Settings of tracking."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from mien.errors import UserError
from mien.ranges import COUNT, NOT_NEGATIVE, POSITIVE, Range, check_ranges
from mien.tracking.paper_settings import PaperSettings
from mien.tracking.photometric_settings import PhotometricSettings

_FOCALS = (10.0, 1e6)
"""Smallest and largest focal length in pixels: a fisheye thumbnail, and a 16K picture through a telescope."""
_DEVIATION = Range(5e-324, math.inf, words="a number above 0, or inf for none")

LandmarkSet = Literal["mediapipe", "ibug51"]
"""All 478 landmarks, or the 68 of 300-W without their contour (supplement of GaussianAvatars, section A) and irises."""


@dataclass(frozen=True)
class SmoothnessSettings:
    """Smoothness over time: standard deviations of accelerations. Smaller is smoother; inf switches a term off."""

    translation: Annotated[float, _DEVIATION] = 0.1
    """Acceleration of the head across the line of sight, in metres per second squared."""
    depth: Annotated[float, _DEVIATION] = 0.2
    """Acceleration of the head along the line of sight, which a single camera sees least well, in metres per second
    squared."""
    rotation: Annotated[float, _DEVIATION] = 2.0
    """Angular acceleration of the head, in radians per second squared."""
    expression: Annotated[float, _DEVIATION] = 100.0
    """Second derivative of expression coefficients, per second squared. Those of the eyes and eyelids are not smoothed,
    because they move too fast."""


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of the tracking."""

    focal: float | None = None
    """Focal length in pixels of the capture's pictures, if known. The default is 1.5 times the larger side of the
    source picture, or 2.2 times the side of a square picture, which must be a crop. The fit changes the default only a
    little, because landmarks of a face hardly determine it. Calibrated cameras keep their own."""
    same_camera: bool = False
    """State that all sequences were filmed with the same camera and zoom, so that they share one focal length."""
    landmarks: LandmarkSet = "mediapipe"
    """The landmarks that count: all 478 of MediaPipe, or, as in GaussianAvatars, the 68 of 300-W without their 17
    contour points. Irises always count, for the gaze."""
    keyframes: Annotated[int, COUNT] = 20
    """Frames of each sequence from which identity is fitted. They are chosen for different head poses."""
    landmark_sigma: Annotated[float, POSITIVE] = 0.0015
    """Expected error of a landmark, in metres on the face."""
    independent_landmarks: Annotated[float, POSITIVE] = 25.0
    """Number of independent landmarks that all landmarks of a picture are worth, because their errors are correlated.
    It weighs them against priors and smoothness."""
    outlier: Annotated[float, POSITIVE] = 6.0
    """Number of sigmas beyond which a landmark's pull fades."""
    identity_weight: Annotated[float, NOT_NEGATIVE] = 4.0
    """Weight of the identity's unit-variance prior."""
    bias_sigma: Annotated[float, POSITIVE] = 0.003
    """Standard deviation of a landmark's offset on the subject from the model's, in metres. All sequences share the
    offsets. It is used only for face models without a measured `mien.tracking.detector_response`."""
    smoothness: SmoothnessSettings = field(default_factory=SmoothnessSettings)
    """Smoothness over time."""
    schedule: Literal["landmarks", "fast", "paper"] = "fast"
    """Stages of the fit. landmarks: fit landmarks alone. fast: then fit pixels, with one texture for all pictures.
    paper: then refine everything by gradient descent over frames in random order (GaussianAvatars), which takes many
    times longer."""
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    """The fit to pixels of the schedule `fast`."""
    paper: PaperSettings = field(default_factory=PaperSettings)
    """The gradient descent of the schedule `paper`."""

    def check(self) -> None:
        """Raise a UserError that names the first invalid value."""
        focal = self.focal
        if focal is not None and not _FOCALS[0] <= focal <= _FOCALS[1]:
            raise UserError(
                f"--tracking.focal {focal:g}: give the focal length in pixels of the captured pictures, about 1 to 3 "
                "times their width, or leave it out"
            )
        check_ranges(self, lambda name: f"--tracking.{name.replace('_', '-')}")

    def in_effect(self) -> "TrackingSettings":
        """The settings that a tracking depends on: those that its schedule does not use are at their defaults."""
        paper = self.paper if self.schedule == "paper" else PaperSettings()
        by_pixels = self.schedule == "fast" or (self.schedule == "paper" and paper.start == "fast")
        return replace(self, paper=paper, photometric=self.photometric if by_pixels else PhotometricSettings())
