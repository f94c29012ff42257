"""Numbers of tracking by gradient descent, the schedule `paper`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DescentConstants:
    """The schedule `paper`, by the file of `descent` that uses them (log, "The paper's schedule")."""

    # adam.py
    settled_gradient: float = 2.0
    """Gradient of a squared cost at one standard deviation; it damps steps with smaller gradients. Plain Adam moves by
    its whole rate however small the gradient is. Measured against none: jitter falls from 0.034 to 0.014 mm (log)."""

    # epochs.py
    global_rate: float = 0.1
    """Factor of the initial learning rates in the first epoch. Not varied."""
    epoch_decay: float = 0.9
    """Factor of the learning rates from one epoch to the next. Not varied."""
    good_cosine: float = 0.5
    """Least cosine of the viewing angle at which a triangle's texels count fully. Below it they count in proportion.
    Not varied."""
    most_batches: int = 40
    """Largest number of batches in an epoch. Frames err alike, so longer clips need no more steps of shared parameters.
    Chosen instead of a step for each frame (log); not varied."""
    texture_every: int = 4
    """Fewest frames whose texture gradients are summed for one step. A step of the texture costs as much as a picture.
    Chosen for speed; not varied."""

    # frames.py
    last_rate: float = 0.1
    """Factor of the learning rates at the last of a frame's steps. Not varied."""
    texture_gain: float = 0.15
    """Cosine by which a frame must see a triangle more frontally than earlier frames for its texels to be learned
    again. Not varied."""
    texture_least_cosine: float = 0.1
    """Least cosine of the viewing angle at which a frame's texels are learned at all. Not varied."""
    texture_frames: int = 40
    """Number of frames of each sequence from which texture and light are fitted before the epochs. Not varied."""
    texture_rounds: int = 6
    """Number of steps at each of these frames. Not varied."""
    lost_landmarks: float = 3.0
    """Standard deviations by which landmarks must be farther off than in their own fit to be lost. Not varied."""
    light_every: int = 10
    """Number of a frame's steps between estimates of the unexplained light in its pictures. Chosen for speed; not
    varied."""
    first_converged: float = 0.01
    """Share by which a turn of the very first frame's steps must lower its cost for another turn. Not varied."""
    first_most_turns: int = 8
    """Largest number of turns. One alone leaves vertices 1.51 mm off instead of 1.48 on drawn frames."""
    further_start_divisor: int = 5
    """The first frames of further sequences get the first frame's number of steps divided by this. Not varied."""

    # terms.py
    blur_at: float = 4.0
    """For a wide blur, pictures are scaled down until its standard deviation is about this many pixels. Chosen for
    speed; not varied."""
    light_difference: float = 0.1
    """Colour difference (0..1) above which a pixel hardly counts as light. Not varied."""
