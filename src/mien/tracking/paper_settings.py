"""What a user may choose about the `paper` schedule."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mien.ranges import COUNT_OR_NONE, FRACTION, NOT_NEGATIVE, POSITIVE, Range
from mien.tracking.photometric_settings import TEXELS


@dataclass(frozen=True)
class PaperRates:
    """Adam's step sizes where a fit starts; the global epochs begin at a tenth of them."""

    frame: Annotated[float, NOT_NEGATIVE] = 0.3
    """Of a frame's own parameters, in standard deviations that its landmarks leave them (so that head rotation and
    translation, or two expressions that look alike, are not in each other's way)."""
    identity: Annotated[float, NOT_NEGATIVE] = 1e-2
    """Of identity coefficients."""
    offsets: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Of vertex offsets, metres."""
    texture: Annotated[float, NOT_NEGATIVE] = 1e-2
    """Of albedo, 0..1."""
    light: Annotated[float, NOT_NEGATIVE] = 5e-3
    """Of SH coefficients."""
    focal: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Of the logarithm of an unknown focal length."""


@dataclass(frozen=True)
class PaperSettings:
    """Tracking as in the supplement of GaussianAvatars (section A), by gradient descent; started better."""

    start: Literal["fast", "landmarks"] = "fast"
    """fast: the global epochs begin where the schedule `fast` ends, which is better and quicker. landmarks: all as in
    the supplement: the first frame to convergence, then each next one from the one before it, then the epochs."""
    first_steps: Annotated[int, COUNT_OR_NONE] = 500
    """Optimiser steps at the first frame, half of them for texture and light alone. Only from landmarks."""
    steps: Annotated[int, COUNT_OR_NONE] = 50
    """Steps for each next frame, which starts where the frame before it ended. Only from landmarks."""
    epochs: Annotated[int, COUNT_OR_NONE] = 30
    """Passes over all frames in random order that refine everything."""
    texture_size: Annotated[int, TEXELS] = 512
    """Texels along each side."""
    texture_steps: Annotated[int, COUNT_OR_NONE] = 8
    """Steps for texels that a frame shows better than those before it. Only from landmarks."""
    shrink: Annotated[int, Range(1, 64)] = 1
    """Fit to pictures shrunk by this: 2 is four times as fast, and less exact."""
    color_weight: Annotated[float, NOT_NEGATIVE] = 3e3
    """Of the mean difference between picture and rendering (0..1); squared standard deviations count 1 each."""
    color_epsilon: Annotated[float, POSITIVE] = 0.02
    """Differences of colours smaller than this pull less and less."""
    light_extent: Annotated[float, POSITIVE] = 0.012
    """Metres on the face over which a smooth difference counts as light that the model does not explain."""
    landmark_share: Annotated[float, FRACTION] = 0.3
    """Weight of landmarks, of theirs in the fit to landmarks alone."""
    gap_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Of the gaps between lids and between lips, of a landmark's own weight."""
    identity_sigma: Annotated[float, POSITIVE] = 0.5
    """How far identity may go from where landmarks had it."""
    offset_sigma: Annotated[float, NOT_NEGATIVE] = 0.002
    """Of vertex offsets, metres; 0 switches them off."""
    offset_bend: Annotated[float, POSITIVE] = 0.0001
    """Of the difference between a vertex's offset and its neighbours' mean, metres."""
    texture_roughness: Annotated[float, NOT_NEGATIVE] = 0.1
    """Of the difference between neighbouring texels."""
    light_sigma: Annotated[float, POSITIVE] = 0.3
    """Of SH coefficients, beside an even light."""
    grey_sigma: Annotated[float, POSITIVE] = 0.05
    """Of the difference between the light's colours."""
    focal_sigma: Annotated[float, POSITIVE] = 0.03
    """Of the logarithm of an unknown focal length, beside where landmarks had it."""
    rates: PaperRates = field(default_factory=PaperRates)
    """Step sizes."""
