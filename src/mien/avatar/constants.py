"""Numbers that decide what avatars of several methods look like and that no setting changes, with how each was chosen.

"Not varied" means that the first value worked and no other was measured. Each method has constants of its own.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class AvatarConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # avatar.py
    calm_share: float = 0.1
    """Share of the timesteps that are used to estimate the expression at rest. Not varied."""

    # bound_surface.py
    fill_height_share: float = 0.9
    """Height of a fill as a share of the hair's. Hair is thinner at its outline, and a higher fill stands out beyond
    it. Measured: 0.5 has 0.2 dB more at 30 degrees and 0.3 less at 90, and 1 has 0.2 dB less at 30 (log, 11-24)."""

    # what fills the surface of a bound method, outside and inside the mouth
    fill_opacity: float = 0.97
    """Opacity of a fill. Not varied."""

    # filmed.py
    filmed_least_spread: float = 0.3
    """Spread that every direction of expressions has at least, relative to the largest. Without it, one hardly filmed
    expression would count as far outside, however weak it is. Not varied."""

    # ops/expression_changes.py
    expressions_beyond: float = 1.2
    """How far activations may go, relative to those of the training frames. 98 % of the held-out frames of wojtek go up
    to 1.14, of d3 up to 1.06, of other clips up to 1.21. With 1, wojtek's held-out frames lose 0.03 dB (11-27)."""
    expressions_least_deviation: float = 0.1
    """Smallest deviation that is scaled to 1, relative to that of the first direction. Weaker ones stay weak. Not
    varied."""

    # ops/triangle_frames.py
    ellipse_widening: float = 2.0
    """Scales of Gaussians that cover a triangle, in its plane, in its standard deviations. Chosen instead of 1.5 (with
    the true tracking, 0.2 dB less in front and 0.7 at 90 degrees, 0.3 dB more behind and 0.5 from above; 11-23)."""
    ellipse_flatness: float = 0.05
    """Their scale along the normal, in units of the triangle. Not varied."""


AVATAR = AvatarConstants()
