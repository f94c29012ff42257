"""Settings of the `paper` schedule."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mien.ranges import COUNT_OR_NONE, FRACTION, NOT_NEGATIVE, POSITIVE, Range
from mien.tracking.photometric_settings import TEXELS


@dataclass(frozen=True)
class PaperRates:
    """Learning rates of Adam at the start of a fit. The global epochs start at a tenth of them."""

    frame: Annotated[float, NOT_NEGATIVE] = 0.3
    """Learning rate of a frame's own parameters, in standard deviations that its landmarks leave, so that head rotation
    and translation, or two expressions that look alike, do not hinder each other."""
    identity: Annotated[float, NOT_NEGATIVE] = 1e-2
    """Learning rate of identity coefficients."""
    offsets: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Learning rate of vertex offsets, in metres."""
    texture: Annotated[float, NOT_NEGATIVE] = 1e-2
    """Learning rate of the albedo (0..1)."""
    light: Annotated[float, NOT_NEGATIVE] = 5e-3
    """Learning rate of the light's spherical harmonics."""
    focal: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Learning rate of the logarithm of an unknown focal length."""


@dataclass(frozen=True)
class PaperSettings:
    """Tracking by gradient descent as in the supplement of GaussianAvatars (section A), from a better start."""

    start: Literal["fast", "landmarks"] = "fast"
    """Start of the fit. fast: the global epochs start from the result of the schedule `fast`, which is better and
    quicker. landmarks: as in the supplement, the first frame is fitted to convergence, then each next frame from the
    one before it, then the epochs run."""
    first_steps: Annotated[int, COUNT_OR_NONE] = 500
    """Optimiser steps at the first frame, half of them for texture and light alone. Only with start `landmarks`."""
    steps: Annotated[int, COUNT_OR_NONE] = 50
    """Optimiser steps for each next frame, which starts from the frame before it. Only with start `landmarks`."""
    epochs: Annotated[int, COUNT_OR_NONE] = 30
    """Passes over all frames in random order that refine everything."""
    texture_size: Annotated[int, TEXELS] = 512
    """Texels along each side of the texture."""
    texture_steps: Annotated[int, COUNT_OR_NONE] = 8
    """Optimiser steps for texels that a frame shows better than earlier frames. Only with start `landmarks`."""
    shrink: Annotated[int, Range(1, 64)] = 1
    """Factor by which pictures are scaled down for the fit. 2 is four times as fast, and less exact."""
    color_weight: Annotated[float, NOT_NEGATIVE] = 3e3
    """Weight of the mean colour difference (0..1) between picture and rendering. In the other costs, one squared
    standard deviation counts 1."""
    color_epsilon: Annotated[float, POSITIVE] = 0.02
    """Colour difference below which the pull fades."""
    light_extent: Annotated[float, POSITIVE] = 0.012
    """Extent on the face, in metres, over which a smooth difference counts as light that the model does not explain."""
    landmark_share: Annotated[float, FRACTION] = 0.3
    """Weight of landmarks, as a share of their weight in the fit to landmarks alone."""
    gap_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the gaps between lids and between lips, relative to a landmark's weight."""
    identity_sigma: Annotated[float, POSITIVE] = 0.5
    """Standard deviation of identity coefficients from those of the fit to landmarks."""
    offset_sigma: Annotated[float, NOT_NEGATIVE] = 0.002
    """Standard deviation of vertex offsets, in metres; 0 switches them off."""
    offset_bend: Annotated[float, POSITIVE] = 0.0001
    """Standard deviation of a vertex's offset from the mean of its neighbours', in metres."""
    texture_roughness: Annotated[float, NOT_NEGATIVE] = 0.1
    """Standard deviation of the difference between neighbouring texels."""
    light_sigma: Annotated[float, POSITIVE] = 0.3
    """Standard deviation of the light's spherical harmonics from an even light."""
    grey_sigma: Annotated[float, POSITIVE] = 0.05
    """Standard deviation of the light's colour channels from their mean."""
    focal_sigma: Annotated[float, POSITIVE] = 0.03
    """Standard deviation of the logarithm of an unknown focal length from that of the fit to landmarks."""
    rates: PaperRates = field(default_factory=PaperRates)
    """Learning rates."""
