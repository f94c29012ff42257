"""What a user may choose about the photometric stage."""

from dataclasses import dataclass

from mien.tracking.ranges import COUNT, COUNT_OR_NONE, NOT_NEGATIVE, POSITIVE, TEXELS, check_ranges

_RANGES = {
    "sizes": (16, 8192), "texture_size": TEXELS, "texture_frames": COUNT, "reference_angle": POSITIVE,
    "shared_steps": COUNT_OR_NONE, "shared_steps_of_cameras": COUNT_OR_NONE, "keyframes": COUNT,
    "focal_sigma": POSITIVE, "outline_weight": NOT_NEGATIVE, "independent_pixels": POSITIVE,
    "independent_pixels_of_frames": POSITIVE, "landmark_share": (0.0, 1.0), "light_extent": POSITIVE,
    "outlier": POSITIVE, "lids": NOT_NEGATIVE,
}  # fmt: skip


@dataclass(frozen=True)
class PhotometricSettings:
    """How faces are fitted to pixels, after the fit to landmarks."""

    sizes: tuple[int, ...] = (256, 256)
    """Rounds, each at pictures shrunk by the whole number that brings their shorter side nearest to this, pixels; the
    texture is made anew before each."""
    texture_size: int = 512
    """Texels along each side."""
    texture_frames: int = 48
    """Frames of each sequence that make the texture."""
    reference_angle: float = 0.12
    """Radians of head rotation away from the middle pose within which frames decide the texture; others follow it.
    Were all alike, every pose would keep its own error: the texture shows it where only such frames see the skin.
    With several cameras all are alike: one pose is seen from many sides."""
    shared_steps: int = 3
    """Gauss-Newton steps of identity and focal length before each round but the first."""
    shared_steps_of_cameras: int = 8
    """The same with several cameras: these see depth, so that shape goes on improving."""
    keyframes: int = 24
    """Timesteps of each sequence for these steps; of several cameras fewer, for twice as many pictures at most."""
    focal_sigma: float = 0.04
    """How far the logarithm of an unknown focal length may go from the landmarks'."""
    outline_weight: float = 10.0
    """What the outline of a head in a keyframe is worth, where it ends against the background; 0: nothing. For a single
    camera, which sees perspective by it."""
    independent_pixels: float = 100.0
    """What all pixels of a picture are worth, whose errors go together: weighs them against landmarks and priors. For
    identity and focal length, which many pictures tell together."""
    independent_pixels_of_frames: float = 50.0
    """The same for the steps of frames: much more, and what texture, light and shape have wrong becomes expression, of
    which most goes with the head's turns. Much less, and shape has nothing to go by but landmarks."""
    landmark_share: float = 0.3
    """Weight of landmarks, of theirs in the fit to landmarks alone; those of lips, lids and irises keep all of it."""
    light_extent: float = 0.012
    """Metres on the face over which a smooth difference counts as light that the model does not explain."""
    outlier: float = 10.0
    """Beyond this many standard deviations of its colour a pixel's pull fades. Faces that are off by some pixels make
    most of them differ by several: those are what there is to learn from."""
    lids: float = 1.0
    """What colours in the eyes count, against where landmarks and skin put the lids: 1 as measured, 0 for nothing. The
    detector misses blinks behind glasses."""

    def check(self) -> None:
        """Raise a UserError that names the first value that makes no sense."""
        check_ranges(self, "--tracking.photometric.", _RANGES)
