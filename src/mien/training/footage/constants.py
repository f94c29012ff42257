"""Numbers that decide what training takes from its frames and that no setting changes, with how each was chosen.

"Not varied" means that the first value worked and no other was measured.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class FootageConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # coverage.py, mesh_colors.py
    depth_tolerance: float = 0.004
    """Depth in metres behind the nearest surface up to which something counts as visible. Coverage fades from one to
    two such depths. Not varied."""

    # coverage.py
    coverage_even_frames: int = 48
    """Number of evenly spread frames in which coverage is measured. Not varied."""
    coverage_turned_frames: int = 24
    """Number of other frames: those in which the head turns furthest to each side. Not varied."""
    coverage_facing: tuple[float, float] = (0.1, 0.3)
    """Cosines between a triangle's normal and the direction to the camera, between which its view begins to count. Not
    varied."""
    coverage_enough: float = 1.0
    """Sum of squared cosines over the frames from which a triangle is certain. Rare sights, such as teeth, count fully.
    Geometry: one picture from straight ahead."""
    coverage_cut_softness: float = 0.001
    """Distance in metres below the cut at the neck to which a vertex counts as above. It fades over the same distance.
    Not varied."""

    # filmed.py
    filmed_confidence: float = 0.85
    """Mean confidence of the visible surface from which a view counts as filmed. Set by eye."""
    shown_confidence: float = 0.5
    """The same from which the head of a filled avatar may turn there. Set by eye (log, 11-23)."""
    shown_most_yaw: int = 60
    """Degrees to the side beyond which that does not hold, since fills have no folds. Set by eye (log, 11-23)."""
    shown_most_pitch: int = 30
    """The same up and down."""

    # foreground.py
    foreground_windows: tuple[float, float] = (1 / 11, 1 / 73)
    """Sides of the windows of both passes, as shares of the picture's longer side: 45 and 7 pixels of 500. Two passes
    are of the paper (Forte 2021); the sizes were not varied."""
    foreground_solid: int = 252
    """Opacity from which a pixel is person alone, of 255. Not varied."""

    # frames.py
    extent_margin: float = 1.1
    """Factor on the largest distance of a camera from the mean of all. Of 3D Gaussian Splatting's published code."""
    least_extent: float = 0.5
    """Least extent of the training cameras, in metres. A single fixed camera has an extent of 0: centres would not
    move, and every Gaussian would be too large. Geometry: half a metre is less than a ring of cameras around a head,
    and more than the head. One metre would be above the rig of GaussianAvatars' paper."""
    mixed_share: float = 0.1
    """Share of the steps in which a mixed background has a random colour. Measured on wojtek, 12,000 steps with alpha
    compared at full weight (log, 11-28): 0.1 has 30.4 dB of the head over white and 29.2 over dark blue, 0 has 30.4 and
    28.7, and d3 has pale specks on the cheeks from the side; 0.3 with a fifth of the weight has 30.0 and 28.8."""
    rarity_limit: float = 2.0
    """Largest factor by which rare frames are drawn more often, and common ones less. Not varied."""
    rarity_most_neighbors: int = 100
    """Largest number of neighbours in which a frame's rarity is measured. Not varied."""

    # hidden.py
    hidden_size: int = 256
    """Longer side in pixels of the depth pictures of skin, lids and lips. Not varied."""
    hidden_slack: int = 1
    """Pixels of such a picture by which gaps between lids and lips are wider than those of the mesh, because the
    tracking is not exact. Measured: 0 blurs irises and takes highlights from the eyes of d3 (log, 11-26)."""

    # mesh_colors.py
    color_frames: int = 60
    """Number of evenly spread frames for the mean vertex colours. More make no visible difference."""
    color_spread_rounds: int = 200
    """Number of times that unknown colours are averaged over neighbours. Not varied."""


FOOTAGE = FootageConstants()
