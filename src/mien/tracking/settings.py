"""Settings of tracking: the fit to landmarks, the fit to pixels, and the paper's descent."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from mien.disk.config import COUNT, COUNT_OR_NONE, NOT_NEGATIVE, POSITIVE, Range, check_ranges
from mien.errors import UserError

_FOCALS = (10.0, 1e6)
"""Smallest and largest focal length in pixels: a fisheye thumbnail, and a 16K picture through a telescope."""
_DEVIATION = Range(5e-324, math.inf, words="a number above 0, or inf for none")

LandmarkSet = Literal["mediapipe", "ibug51"]
"""All 478 landmarks, or irises and the 68 of 300-W without their contour (supplement of GaussianAvatars, section A)."""
Cut = Literal["plane", "line", "none"]
"""Lower end of the head in scoring masks."""
_TEXELS = Range(16, 8192)
"""Allowed number of texels along a side of a texture."""


@dataclass(frozen=True)
class SmoothnessSettings:
    """Smoothness over time: standard deviations of accelerations. Smaller is smoother; inf switches a term off."""

    translation: Annotated[float, _DEVIATION] = 0.1
    """Acceleration of the head across the line of sight, in metres per second squared."""
    depth: Annotated[float, _DEVIATION] = 0.2
    """The same along the line of sight, which a single camera sees least well."""
    rotation: Annotated[float, _DEVIATION] = 2.0
    """Angular acceleration of the head, in radians per second squared."""
    expression: Annotated[float, _DEVIATION] = 100.0
    """Second derivative of expression coefficients, per second squared. Those of the eyes and eyelids are not smoothed,
    because they move too fast."""


@dataclass(frozen=True)
class PhotometricSettings:
    """The fit of faces to pixels, after the fit to landmarks."""

    sizes: Annotated[tuple[int, ...], Range(16, 8192, filled=True)] = (256, 256)
    """Size of the pictures in each iteration, in pixels. They are scaled down by the whole number that brings their
    shorter side nearest to it. The texture is estimated again before each iteration."""
    texture_size: Annotated[int, _TEXELS] = 512
    """Texels along each side of the texture."""
    shared_steps: Annotated[int, COUNT_OR_NONE] = 3
    """Gauss-Newton steps of identity and focal length before each iteration but the first."""
    keyframes: Annotated[int, COUNT] = 24
    """Timesteps of each sequence for these steps; fewer with several cameras, for at most twice this many pictures."""
    outline_weight: Annotated[float, NOT_NEGATIVE] = 10.0
    """Weight of the head's outline in a keyframe; 0 switches it off. Only a single camera needs it, for perspective."""
    outlier: Annotated[float, POSITIVE] = 10.0
    """Number of standard deviations of its colour beyond which a pixel's pull fades. It is large, because faces that
    are off by some pixels make most pixels differ by several, and the fit learns from those."""
    lids: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the colours in the eyes against the lids of the fit: 1 as measured, 0 switches it off. The detector
    misses blinks behind glasses."""


@dataclass(frozen=True)
class PaperSettings:
    """Tracking by gradient descent as in the supplement of GaussianAvatars (section A), or from a better start."""

    start: Literal["landmarks", "fast"] = "landmarks"
    """Start of the fit. landmarks: as in the supplement, all parameters are fitted to the first frame, then each next
    frame from the one before it, then the epochs run, with offsets on all vertices. fast: the epochs start from the
    result of the schedule `fast`, and what pictures do not show has no offsets, which is better and quicker."""
    first_steps: Annotated[int, COUNT_OR_NONE] = 500
    """Optimiser steps of a turn at the first frame, half of those of the first turn for texture and light alone. Turns
    follow until the cost falls by less than a hundredth. Only with start `landmarks`."""
    steps: Annotated[int, COUNT_OR_NONE] = 50
    """Optimiser steps for each next frame. Only with start `landmarks`."""
    pass_smoothness: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the smoothness of motion while each frame is fitted from those before it; 0 leaves it out. The epochs
    have all of it, but with 1 here, 16 drawn frames drift by 23 instead of 6 mm. Only with start `landmarks`."""
    epochs: Annotated[int, COUNT_OR_NONE] = 30
    """Passes over all frames in random order that refine everything."""
    texture_size: Annotated[int, _TEXELS] = 512
    """Texels along each side of the texture."""


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of the tracking."""

    focal: float | None = None
    """Focal length in pixels of the capture's pictures, if known. The default is 1.5 times the larger side of the
    source picture, or 2.2 times the side of a square picture, which must be a crop. The fit changes the default only a
    little, because landmarks of a face hardly determine it. Calibrated cameras keep their own."""
    same_camera: bool = False
    """State that all sequences were filmed with the same camera and zoom, so that they share one focal length."""
    landmarks: Literal["auto", "mediapipe", "ibug51"] = "auto"
    """The landmarks that count: all 478 of MediaPipe, or, as in GaussianAvatars, the 68 of 300-W without their 17
    contour points. Irises always count, for the gaze. auto: ibug51 for the schedule `paper` from landmarks, else
    mediapipe."""
    keyframes: Annotated[int, COUNT] = 20
    """Frames of each sequence from which identity is fitted. They are chosen for different head poses."""
    identity_weight: Annotated[float, NOT_NEGATIVE] = 4.0
    """Weight of the identity's unit-variance prior."""
    smoothness: SmoothnessSettings = field(default_factory=SmoothnessSettings)
    """Smoothness over time."""
    schedule: Literal["landmarks", "fast", "paper"] = "fast"
    """Stages of the fit. landmarks: fit landmarks alone. fast: then fit pixels, with one texture for all pictures.
    paper: gradient descent as in the supplement of GaussianAvatars, which takes many times longer and is worse."""
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

    @property
    def published(self) -> bool:
        """Whether the fit is the supplement's, from landmarks on."""
        return self.schedule == "paper" and self.paper.start == "landmarks"

    @property
    def landmark_set(self) -> LandmarkSet:
        """The landmarks that count."""
        return self.landmarks if self.landmarks != "auto" else "ibug51" if self.published else "mediapipe"

    def in_effect(self) -> "TrackingSettings":
        """The settings that a tracking depends on: those that its schedule does not use have the same values always."""
        paper = self.paper if self.schedule == "paper" else PaperSettings("fast", pass_smoothness=0.0)
        by_pixels = self.schedule != "landmarks" and not self.published
        photometric = self.photometric if by_pixels else PhotometricSettings()
        return replace(self, landmarks=self.landmark_set, paper=paper, photometric=photometric)


@dataclass(frozen=True)
class ScoringSettings:
    """Settings of the scoring mask: what is trained on and scored."""

    cut: Literal["auto", "plane", "line", "none"] = "auto"
    """Lower end of the head in the masks. plane: a plane across the lower neck, which all cameras see alike; the
    projected head stays whole. line: as in the supplement of GaussianAvatars, a line in space across the base of the
    neck, below which everything goes; for figures beside those of that protocol. none: the whole person, to the edge
    of the picture. auto: none for face models with a torso, line for the tracking schedule `paper` from landmarks, else
    plane. Masks are written once, so a sequence keeps its cut."""

    def cut_after(self, tracking: TrackingSettings, *, torso: bool) -> Cut:
        """The cut of sequences that were tracked with these settings and a face model with or without a torso."""
        if self.cut != "auto":
            return self.cut
        return "none" if torso else "line" if tracking.published else "plane"
