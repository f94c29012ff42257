"""What a user may choose about the `paper` schedule."""

from dataclasses import dataclass, field
from typing import Literal

from mien.tracking.ranges import COUNT_OR_NONE, NOT_NEGATIVE, POSITIVE, TEXELS, check_ranges

_RANGES = {
    "first_steps": COUNT_OR_NONE, "steps": COUNT_OR_NONE, "epochs": COUNT_OR_NONE, "texture_size": TEXELS,
    "texture_steps": COUNT_OR_NONE, "shrink": (1, 64), "color_weight": NOT_NEGATIVE, "color_epsilon": POSITIVE,
    "light_extent": POSITIVE, "landmark_share": (0.0, 1.0), "gap_weight": NOT_NEGATIVE, "identity_sigma": POSITIVE,
    "offset_sigma": NOT_NEGATIVE, "offset_bend": POSITIVE, "texture_roughness": NOT_NEGATIVE, "light_sigma": POSITIVE,
    "grey_sigma": POSITIVE, "focal_sigma": POSITIVE,
}  # fmt: skip
_RATES = {name: NOT_NEGATIVE for name in ("frame", "identity", "offsets", "texture", "light", "focal")}


@dataclass(frozen=True)
class PaperRates:
    """Adam's step sizes where a fit starts; the global epochs begin at a tenth of them."""

    frame: float = 0.3
    """Of a frame's own parameters, in standard deviations that its landmarks leave them (so that head rotation and
    translation, or two expressions that look alike, are not in each other's way)."""
    identity: float = 1e-2
    """Of identity coefficients."""
    offsets: float = 1e-4
    """Of vertex offsets, metres."""
    texture: float = 1e-2
    """Of albedo, 0..1."""
    light: float = 5e-3
    """Of SH coefficients."""
    focal: float = 1e-3
    """Of the logarithm of an unknown focal length."""


@dataclass(frozen=True)
class PaperSettings:
    """Tracking as in the supplement of GaussianAvatars (section A), by gradient descent; started better."""

    start: Literal["fast", "landmarks"] = "fast"
    """fast: the global epochs begin where the schedule `fast` ends, which is better and quicker. landmarks: all as in
    the supplement: the first frame to convergence, then each next one from the one before it, then the epochs."""
    first_steps: int = 500
    """Optimiser steps at the first frame, half of them for texture and light alone. Only from landmarks."""
    steps: int = 50
    """Steps for each next frame, which starts where the frame before it ended. Only from landmarks."""
    epochs: int = 30
    """Passes over all frames in random order that refine everything."""
    texture_size: int = 512
    """Texels along each side."""
    texture_steps: int = 8
    """Steps for texels that a frame shows better than those before it. Only from landmarks."""
    shrink: int = 1
    """Fit to pictures shrunk by this: 2 is four times as fast, and less exact."""
    color_weight: float = 3e3
    """Of the mean difference between picture and rendering (0..1); squared standard deviations count 1 each."""
    color_epsilon: float = 0.02
    """Differences of colours smaller than this pull less and less."""
    light_extent: float = 0.012
    """Metres on the face over which a smooth difference counts as light that the model does not explain."""
    landmark_share: float = 0.3
    """Weight of landmarks, of theirs in the fit to landmarks alone."""
    gap_weight: float = 1.0
    """Of the gaps between lids and between lips, of a landmark's own weight."""
    identity_sigma: float = 0.5
    """How far identity may go from where landmarks had it."""
    offset_sigma: float = 0.002
    """Of vertex offsets, metres; 0 switches them off."""
    offset_bend: float = 0.0001
    """Of the difference between a vertex's offset and its neighbours' mean, metres."""
    texture_roughness: float = 0.1
    """Of the difference between neighbouring texels."""
    light_sigma: float = 0.3
    """Of SH coefficients, beside an even light."""
    grey_sigma: float = 0.05
    """Of the difference between the light's colours."""
    focal_sigma: float = 0.03
    """Of the logarithm of an unknown focal length, beside where landmarks had it."""
    rates: PaperRates = field(default_factory=PaperRates)
    """Step sizes."""

    def check(self) -> None:
        """Raise a UserError that names the first value that makes no sense."""
        check_ranges(self, "--tracking.paper.", _RANGES)
        check_ranges(self.rates, "--tracking.paper.rates.", _RATES)
