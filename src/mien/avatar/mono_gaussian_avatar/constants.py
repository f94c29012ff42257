"""Numbers that decide what this method's avatars look like and that no setting changes, with how each was chosen.

Lengths in units of the paper are multiplied by `LENGTH_UNIT`. Needs no torch.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class MonoGaussianAvatarConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # avatar.py
    canonical_jaw: float = 0.4
    """Angle by which the jaw is open in the canonical face, in radians. As published (log, 11-23)."""
    pretraining_points: int = 1024
    """Points of a step of pre-training on the face model's motion. Not varied."""
    pretraining_frames: int = 4
    """Frames of such a step. Not varied."""
    pretraining_rate: float = 3e-3
    """Learning rate of its first step. It falls to a tenth. Not varied."""
    pretraining_weight: float = 100.0
    """Weight of the distance between points and their places on the moved mesh, beside the losses that keep the
    networks near the face model. Not varied."""

    # networks.py
    skinning_sharpness: float = 20.0
    """Factor on the logits of the skinning weights: their softmax has a temperature of 1/20. As published."""
    sphere_radius: float = 0.6
    """Radius of the sphere whose distance a network gives at the start. As published."""

    # schedule.py
    first_radius: float = 0.15 * 0.75 ** math.log2(400 / 100)
    """Radius at the first epoch, of 400 points, in units of the paper. It follows from the published radius of 100."""
    radius_factor: float = 0.75
    """Factor on the radius each time that it shrinks. As published."""
    radius_factor_at_60: float = 0.9
    """Factor on the radius at epoch 60 in the schedule `code`. As published."""
    late_length: float = 0.004
    """Distance of children from their parents after epoch 100, in units of the paper. As published."""
    face_halvings: tuple[int, ...] = (20, 30, 50, 70)
    """Epochs at which the weight of the face model's terms halves. As published."""


MONO = MonoGaussianAvatarConstants()
