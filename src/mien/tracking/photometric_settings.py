"""Settings of the photometric stage."""

from dataclasses import dataclass
from typing import Annotated

from mien.ranges import COUNT, COUNT_OR_NONE, FRACTION, NOT_NEGATIVE, POSITIVE, Range

TEXELS = Range(16, 8192)
"""Allowed number of texels along a side of a texture."""


@dataclass(frozen=True)
class PhotometricSettings:
    """The fit of faces to pixels, after the fit to landmarks."""

    sizes: Annotated[tuple[int, ...], Range(16, 8192, filled=True)] = (256, 256)
    """Size of the pictures in each round, in pixels. They are scaled down by the whole number that brings their shorter
    side nearest to it. The texture is estimated again before each round."""
    texture_size: Annotated[int, TEXELS] = 512
    """Texels along each side of the texture."""
    texture_frames: Annotated[int, COUNT] = 48
    """Frames of each sequence that the texture is estimated from."""
    reference_angle: Annotated[float, POSITIVE] = 0.12
    """Head rotation from the median pose, in radians, within which frames decide the texture; others hardly count. With
    equal weights every pose would keep its own error, because the texture would reproduce it wherever only such frames
    see the skin. With several cameras all frames count alike, because each pose is seen from many sides."""
    shared_steps: Annotated[int, COUNT_OR_NONE] = 3
    """Gauss-Newton steps of identity and focal length before each round but the first."""
    shared_steps_of_cameras: Annotated[int, COUNT_OR_NONE] = 8
    """The same number for several cameras. They see depth, so the shape keeps improving for more steps."""
    keyframes: Annotated[int, COUNT] = 24
    """Timesteps of each sequence for these steps. With several cameras there are fewer, so that the number of pictures
    is at most about twice this number."""
    focal_sigma: Annotated[float, POSITIVE] = 0.04
    """Standard deviation of the logarithm of an unknown focal length from that of the fit to landmarks."""
    outline_weight: Annotated[float, NOT_NEGATIVE] = 10.0
    """Weight of the outline of a head against the background in a keyframe; 0 switches it off. It is used only with a
    single camera, which needs the outline to see perspective."""
    independent_pixels: Annotated[float, POSITIVE] = 100.0
    """Number of independent pixels that all pixels of a picture are worth, because their errors are correlated. It
    weighs them against landmarks and priors in the steps of identity and focal length, which use many pictures."""
    independent_pixels_of_frames: Annotated[float, POSITIVE] = 50.0
    """The same number for the steps of frames. If it is much larger, errors of texture, light and shape become
    expressions, most of which follow the head's turns. If it is much smaller, only landmarks determine the shape."""
    landmark_share: Annotated[float, FRACTION] = 0.3
    """Weight of landmarks, as a share of their weight in the fit to landmarks alone. Those of lips, lids and irises
    keep their full weight."""
    light_extent: Annotated[float, POSITIVE] = 0.012
    """Extent on the face, in metres, over which a smooth difference counts as light that the model does not explain."""
    outlier: Annotated[float, POSITIVE] = 10.0
    """Number of standard deviations of its colour beyond which a pixel's pull fades. It is large, because faces that
    are off by some pixels make most pixels differ by several, and the fit learns from those."""
    lids: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the colours in the eyes against the lids of the fit: 1 as measured, 0 switches it off. The detector
    misses blinks behind glasses."""
