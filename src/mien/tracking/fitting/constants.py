"""Numbers of the start of a fit: cameras, and priors of joints and expressions."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraConstants:
    """Assumptions about a camera, and landmarks that are averaged before the fit: `fitting/shot.py`."""

    focal: float = 1.5
    """Focal length of an unknown camera, in larger sides of the source picture. It lies between a phone's wide lens and
    a portrait lens. Not varied."""
    cropped_focal: float = 2.2
    """The same for a nearly square picture. No camera films squares, so the picture was cropped around a head. Measured
    against 1.5: d3 gains 0.3 dB, and wojtek nothing (log, "Focal length")."""
    square: float = 1.1
    """Ratio of sides below which a picture counts as square. Not varied."""
    swing: float = 0.3
    """Largest ratio of squared motion over two frames to the sum of both squared single-frame motions that counts as a
    swing. The ratio is 0 for a swing, 0.5 for noise and 2 for steady motion. Not varied."""
    swing_frames: int = 4
    """Fewest frames in a row that swing. A blink is a single swing and is kept. Measured against no averaging: the
    jitter of beard falls from 0.104 to 0.055 mm, and footage does not change (log, "The landmark detector")."""


@dataclass(frozen=True)
class PriorConstants:
    """Priors and bounds of joints and expressions: `fitting/parameters.py`."""

    joint_sigmas: tuple[tuple[str, tuple[float, float, float]], ...] = (
        ("eye", (0.4, 0.4, 0.0)), ("neck", (0.0, 0.0, 0.0)), ("jaw", (0.25, 0.05, 0.03)),
    )  # fmt: skip
    """Prior standard deviations of joint angles in radians, by a word in the joint's name; 0 fixes an angle. Eyes do
    not roll, a face says nothing about its neck, and a jaw opens (about x), shifts a little (about y) and hardly
    twists. Anatomy, not varied."""
    other_joint_sigmas: tuple[float, float, float] = (0.2, 0.2, 0.2)
    """The same for all other joints, which no face model has so far."""
    jaw_bounds: tuple[float, float] = (-0.03, 0.6)
    """Bounds of the jaw's opening angle in radians. Teeth stop it one way, ligaments the other. Anatomy, not varied."""
    jaw_open: float = 0.35
    """Opening angle of a wide open mouth, in radians. Anatomy, not varied."""
    eyes_alike_sigmas: tuple[float, float] = (0.1, 0.03)
    """Standard deviations of the difference of the two eyes' angles (up-down, left-right), in radians. The eyes look at
    the same thing. Not varied."""
    expression_sigmas: tuple[tuple[str, float], ...] = (
        ("brow", 0.25), ("cheek", 0.3), ("nose", 0.3), ("jaw", 0.5), ("mouth", 0.4), ("eyeLook", 0.3),
        ("eyeBlink", 2.0), ("eyeWide", 1.0), ("eye", 0.5),
    )  # fmt: skip
    """Prior standard deviations of expression coefficients, by the beginning of their name. That of brows is small,
    because otherwise they follow the head's pitch. Not varied one by one. Measured: a third of all of them has the same
    errors, and d3's frown shrinks to a third (log, "Fit to pixels")."""
    other_expression_sigma: float = 0.4
    """The same for all other names. Not varied."""
