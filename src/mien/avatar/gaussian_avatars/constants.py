"""Numbers that decide what this method's avatars look like and that no setting changes, with how each was chosen.

"Not varied" means that the first value worked and no other was measured.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class GaussianAvatarsConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # hair_strands.py
    strands_per_area: float = 150_000.0
    """Strands per square metre of scalp. Set by eye (log, 11-24)."""
    strand_length: float = 0.005
    """Scale (standard deviation) along a strand, in metres. Not varied."""
    strand_width: float = 0.001
    """Scale across it, in metres. Not varied."""
    strand_thickness: float = 0.0004
    """Scale along the normal, in metres. Not varied."""
    strand_opacity: float = 0.7
    """Opacity of a strand. Not varied."""
    strand_down: float = 1.0
    """Downward part of a strand's direction in the head frame. Set by eye."""
    strand_back: float = 0.6
    """Backward part of this direction. Set by eye."""
    strand_disorder: float = 0.15
    """Standard deviation of each coordinate of this direction. Set by eye."""
    strand_contrast: float = 0.2
    """Standard deviation of the logarithm of a strand's brightness. Measured: 0.3, with strands on top of the hair, has
    .217 in ST-LPIPS at 90 degrees instead of .199 (log, 11-24)."""
    strand_depth: float = 0.003
    """Range below the top of the hair in which strands lie, in metres. Above it, they would widen the outline.
    Measured: 1 mm has .205 in ST-LPIPS at 90 degrees, 3 mm .183 (log, 11-24)."""
    head_radius: float = 0.1
    """Radius in metres of the head that hair is a shell around. Geometry of a head."""
    neck_radius: float = 0.055
    """Radius in metres of the neck that hanging hair is a shell around. Geometry of a neck."""
    chin_level: float = -0.05
    """Level in the head frame, in metres, below which hair is around the neck. Geometry of a head."""

    # surface.py
    open_opacity: float = 0.5
    """Sum of the opacities of a triangle's Gaussians below which its surface is open. Not varied."""
    color_pull: float = 0.05
    """Share of the difference to the completed colour that a step takes away where no picture shows a triangle.
    Measured: a tenth of it has 0.5 dB less in front (log, 11-23)."""


GAUSSIAN_AVATARS = GaussianAvatarsConstants()
