"""What a user may choose about the photometric stage."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PhotometricSettings:
    """How faces are fitted to pixels, after the fit to landmarks."""

    shrinks: tuple[int, ...] = (2, 2)
    """Rounds from coarse to fine, each at pictures shrunk by this; the texture is made anew before each."""
    texture_size: int = 512
    """Texels along each side."""
    texture_frames: int = 48
    """Frames of each sequence that make the texture."""
    reference_angle: float = 0.12
    """Radians of head rotation away from the middle pose within which frames decide the texture; others follow it.
    Were all alike, every pose would keep its own error: the texture shows it where only such frames see the skin."""
    shared_steps: int = 3
    """Gauss-Newton steps of identity and focal length before each round but the first."""
    keyframes: int = 24
    """Frames of each sequence for these steps."""
    focal_sigma: float = 0.03
    """How far the logarithm of an unknown focal length may go from the landmarks' in each keyframe's opinion."""
    independent_pixels: float = 100.0
    """What all pixels of a picture are worth, whose errors go together: weighs them against landmarks and priors."""
    landmark_share: float = 0.3
    """Weight of landmarks, of theirs in the fit to landmarks alone; those of lips, lids and irises keep all of it."""
    light_extent: float = 0.012
    """Metres on the face over which a smooth difference counts as light that the model does not explain."""
    outlier: float = 10.0
    """Beyond this many standard deviations of its colour a pixel's pull fades. Faces that are off by some pixels make
    most of them differ by several: those are what there is to learn from."""
