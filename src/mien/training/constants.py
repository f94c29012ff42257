"""Numbers that decide how a training goes and that no setting changes, with how each was chosen.

"Not varied" means that the first value worked and no other was measured. Sub-rooms have constants of their own.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # alignment.py
    aligned_together: int = 4
    """Number of timesteps that are aligned in one pass. Not varied."""
    aligned_judged: int = 32
    """Number of training timesteps that say how large gradients are. Not varied."""
    aligned_momentum: float = 0.7
    """Share of the last steps' direction in the next one. Measured: the log, 11-27."""
    aligned_expression: float = 10.0
    """Rate of expression coefficients, as a share of that of the head's rotation. Measured: the log, 11-27."""
    aligned_joints: float = 3.0
    """Rate of joint angles, as a share of that of the head's rotation. Measured: the log, 11-27."""
    aligned_shift: float = 0.3
    """Rate of the head's position in metres, as a share of that of its rotation in radians: the ratio with which
    training corrects the tracking. Not varied."""
    aligned_tuning: float = 0.2
    """Share of the learning rates of faces in a training on aligned faces. Measured: the log, 11-27."""

    # batch.py
    least_halved: int = 384
    """Least longer side of pictures that are halved at the start of a run, in pixels. Not varied."""

    # camera_colors.py
    camera_colors_last_rate: float = 0.1
    """Learning rate of the cameras' colours, and of gains, at the last step, as a share of that at the first. Not
    varied."""

    # face_track.py
    still_turns: float = 0.02
    """Standard deviation of a head's turns at which half of what follows them is removed, in radians. Less is removed
    of what follows smaller turns, which explain less. Measured: 0 is as good on three clips that turn (log, 11-26);
    it would take all corrections from a head that hardly turns."""

    # frame_gains.py
    gain_interval: float = 0.1
    """Time in seconds between knots of the gains of timesteps. Automatic exposure takes longer. Not varied."""

    # trainer.py
    steady_every: int = 25
    """Number of steps after which corrections of the head's pose lose what settings do not allow (`steady_pose`). Not
    varied."""
    representative_frames: int = 12
    """Number of evenly spread frames, and of frames that show turned heads, in which hidden Gaussians are looked for.
    Not varied."""


TRAINING = TrainingConstants()
