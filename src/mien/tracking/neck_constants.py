"""Numbers of the cut through the neck."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NeckConstants:
    """The lower end of the head: `neck_line.py`, `neck_cut.py`, `scoring.py`. It decides what is trained and scored."""

    # neck_line.py
    middle: tuple[float, float] = (0.4, 0.7)
    """Range of the middle of the neck, as shares of the way from its base to its top. Set by eye."""

    # neck_cut.py
    raised: float = 0.4
    """Height of the cut above the base of the neck, as a share of the way to the middle of the neck: above most
    collars. Measured: without the raise, the front of `mono-sides` has 2 dB less (log, "Capture", 11-23)."""
    beside: float = 1.15
    """Radius that is kept at the neck cut, in radii of the neck. Set by eye."""
    slope: float = 1.0
    """Growth of that radius with the height above the cut. Hair is kept; collars and shoulders are cut off. Set by
    eye."""

    # scoring.py
    silhouette_margin: float = 0.015
    """Margin around the projected head, in its own widths, because tracking is not exact to the pixel. Not varied."""
    faint: int = 32
    """Least opacity (of 255) of a pixel that counts for connection and for the crop. Not varied."""
