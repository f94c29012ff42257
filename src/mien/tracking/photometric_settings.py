"""What a user may choose about the photometric stage."""

from dataclasses import dataclass
from typing import Annotated

from mien.ranges import COUNT, COUNT_OR_NONE, FRACTION, NOT_NEGATIVE, POSITIVE, Range

TEXELS = Range(16, 8192)
"""Texels along a side of a texture."""


@dataclass(frozen=True)
class PhotometricSettings:
    """How faces are fitted to pixels, after the fit to landmarks."""

    sizes: Annotated[tuple[int, ...], Range(16, 8192, filled=True)] = (256, 256)
    """Rounds, each at pictures shrunk by the whole number that brings their shorter side nearest to this, pixels; the
    texture is made anew before each."""
    texture_size: Annotated[int, TEXELS] = 512
    """Texels along each side."""
    texture_frames: Annotated[int, COUNT] = 48
    """Frames of each sequence that make the texture."""
    reference_angle: Annotated[float, POSITIVE] = 0.12
    """Radians of head rotation away from the middle pose within which frames decide the texture; others follow it.
    Were all alike, every pose would keep its own error: the texture shows it where only such frames see the skin.
    With several cameras all are alike: one pose is seen from many sides."""
    shared_steps: Annotated[int, COUNT_OR_NONE] = 3
    """Gauss-Newton steps of identity and focal length before each round but the first."""
    shared_steps_of_cameras: Annotated[int, COUNT_OR_NONE] = 8
    """The same with several cameras: these see depth, so that shape goes on improving."""
    keyframes: Annotated[int, COUNT] = 24
    """Timesteps of each sequence for these steps; of several cameras fewer, for twice as many pictures at most."""
    focal_sigma: Annotated[float, POSITIVE] = 0.04
    """How far the logarithm of an unknown focal length may go from the landmarks'."""
    outline_weight: Annotated[float, NOT_NEGATIVE] = 10.0
    """What the outline of a head in a keyframe is worth, where it ends against the background; 0: nothing. For a single
    camera, which sees perspective by it."""
    independent_pixels: Annotated[float, POSITIVE] = 100.0
    """What all pixels of a picture are worth, whose errors go together: weighs them against landmarks and priors. For
    identity and focal length, which many pictures tell together."""
    independent_pixels_of_frames: Annotated[float, POSITIVE] = 50.0
    """The same for the steps of frames: much more, and what texture, light and shape have wrong becomes expression, of
    which most goes with the head's turns. Much less, and shape has nothing to go by but landmarks."""
    landmark_share: Annotated[float, FRACTION] = 0.3
    """Weight of landmarks, of theirs in the fit to landmarks alone; those of lips, lids and irises keep all of it."""
    light_extent: Annotated[float, POSITIVE] = 0.012
    """Metres on the face over which a smooth difference counts as light that the model does not explain."""
    outlier: Annotated[float, POSITIVE] = 10.0
    """Beyond this many standard deviations of its colour a pixel's pull fades. Faces that are off by some pixels make
    most of them differ by several: those are what there is to learn from."""
    lids: Annotated[float, NOT_NEGATIVE] = 1.0
    """What colours in the eyes count, against where landmarks and skin put the lids: 1 as measured, 0 for nothing. The
    detector misses blinks behind glasses."""
