"""What a user may choose about tracking."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from mien.errors import UserError
from mien.ranges import COUNT, NOT_NEGATIVE, POSITIVE, Range, check_ranges
from mien.tracking.paper_settings import PaperSettings
from mien.tracking.photometric_settings import PhotometricSettings

_FOCALS = (10.0, 1e6)
"""Pixels that a focal length can have: a thumbnail's fish eye, and a telescope's 16K picture."""
_DEVIATION = Range(5e-324, math.inf, words="a number above 0, or inf for none")

LandmarkSet = Literal["mediapipe", "ibug51"]
"""All 478; or 300-W's 68 without their contour (supplement of GaussianAvatars, section A), and irises."""


@dataclass(frozen=True)
class SmoothnessSettings:
    """Standard deviations of accelerations, a second squared: smaller is smoother. Infinite switches a term off."""

    translation: Annotated[float, _DEVIATION] = 0.1
    """Of the head across the line of sight, metres a second squared."""
    depth: Annotated[float, _DEVIATION] = 0.2
    """Of the head along the line of sight, which one camera sees least well."""
    rotation: Annotated[float, _DEVIATION] = 2.0
    """Of the head, radians a second squared."""
    expression: Annotated[float, _DEVIATION] = 100.0
    """Of expression coefficients except those of the eyelids, which blink too fast to be smoothed."""


@dataclass(frozen=True)
class TrackingSettings:
    """How a capture is tracked from its landmarks."""

    focal: float | None = None
    """Focal length in pixels of the capture's pictures, if known. Otherwise 1.5 times the larger side of the source
    picture, or 2.2 times the side of a square one, which somebody cut out of a larger one. From there the fit may
    move it a little: landmarks of a face hardly tell it. Calibrated cameras keep their own."""
    same_camera: bool = False
    """Whether all sequences were filmed with the same camera and zoom, so that they share one focal length."""
    landmarks: LandmarkSet = "mediapipe"
    """Which landmarks count: all 478 of MediaPipe, or as in GaussianAvatars the 68 of 300-W without their 17 contour
    points. Irises always do, for the gaze."""
    keyframes: Annotated[int, COUNT] = 20
    """Frames of each sequence from which identity is fitted, chosen for their spread of head poses."""
    landmark_sigma: Annotated[float, POSITIVE] = 0.0015
    """Expected error of a landmark, metres on the face."""
    independent_landmarks: Annotated[float, POSITIVE] = 25.0
    """What 478 landmarks are worth, whose errors go together: weighs them against priors and smoothness."""
    outlier: Annotated[float, POSITIVE] = 6.0
    """Beyond this many sigmas a landmark's pull fades."""
    identity_weight: Annotated[float, NOT_NEGATIVE] = 4.0
    """Weight of the identity's unit-variance prior."""
    bias_sigma: Annotated[float, POSITIVE] = 0.003
    """How far a landmark's point on the subject may lie from the model's, metres; one offset for all sequences. For
    face models only that the detector's habits were not measured on (`mien.tracking.detector_response`)."""
    smoothness: SmoothnessSettings = field(default_factory=SmoothnessSettings)
    """Over time."""
    schedule: Literal["landmarks", "fast", "paper"] = "fast"
    """landmarks: fit landmarks alone. fast: then fit the pixels, by a texture common to all pictures. paper: then
    refine all by gradient descent over frames in random order (GaussianAvatars), which takes many times longer."""
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    """Of the fast fit to pixels."""
    paper: PaperSettings = field(default_factory=PaperSettings)
    """Of the paper's fit to pixels."""

    def check(self) -> None:
        """Raise a UserError that names the first value that makes no sense."""
        focal = self.focal
        if focal is not None and not _FOCALS[0] <= focal <= _FOCALS[1]:
            raise UserError(
                f"--tracking.focal {focal:g}: give the focal length in pixels of the captured pictures, about 1 to 3 "
                "times their width, or leave it out"
            )
        check_ranges(self, lambda name: f"--tracking.{name.replace('_', '-')}")

    def in_effect(self) -> "TrackingSettings":
        """With the settings that this schedule does not use at their defaults: what a tracking depends on."""
        paper = self.paper if self.schedule == "paper" else PaperSettings()
        by_pixels = self.schedule == "fast" or (self.schedule == "paper" and paper.start == "fast")
        return replace(self, paper=paper, photometric=self.photometric if by_pixels else PhotometricSettings())
