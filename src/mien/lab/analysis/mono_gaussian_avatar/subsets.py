"""Frames of a training, chosen by their measured pose and expression: A.4 of the supplement."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.runtime.filmed import head_angles
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence

FRONTAL_SHARE, MIXED_SHARE = 0.25, 0.5
"""Shares of the frames in the two subsets."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Pose and expression of the n timesteps that a run trains on."""

    timesteps: tuple[tuple[int, int], ...]
    """Sequence and timestep of each."""
    angles: Float[np.ndarray, "n 2"]
    """Yaw and pitch of the first camera as the head sees it, in radians."""
    expressions: Float[np.ndarray, "n e"]
    """Expression coefficients, each divided by its standard deviation over all timesteps."""


def measure(sequences: list[Sequence], frames: list[Frame]) -> Measured:
    """Pose and expression of the timesteps of some frames."""
    timesteps = sorted({(frame.sequence, frame.timestep) for frame in frames})
    angles, expressions = [], []
    for sequence, timestep in timesteps:
        tracking = sequences[sequence].tracking
        face = tracking.face[timestep]
        position = tracking.cameras[0].position.numpy()
        angles.append(head_angles(face.head_rotation.numpy(), face.head_translation.numpy(), position)[0, :2])
        expressions.append(face.expression[0].numpy())
    values = np.array(expressions, np.float64)
    return Measured(tuple(timesteps), np.array(angles, np.float64), values / np.maximum(values.std(0), 1e-6))


def frontal_quarter(measured: Measured) -> list[int]:
    """The quarter of the timesteps whose view is nearest to the median one, in the order of time."""
    distance = np.linalg.norm(measured.angles - np.median(measured.angles, axis=0), axis=1)
    count = max(1, round(FRONTAL_SHARE * len(distance)))
    return sorted(np.argsort(distance, kind="stable")[:count].tolist())


def mixed_half(measured: Measured) -> list[int]:
    """Half of the timesteps that keeps the range of poses and expressions, in the order of time.

    Each next timestep is the one that is farthest from all that were chosen before. Pose and expression count alike.
    """
    spread = np.maximum(measured.angles.std(0), 1e-6)
    angles = (measured.angles - measured.angles.mean(0)) / spread / np.sqrt(measured.angles.shape[1])
    features = np.concatenate([angles, measured.expressions / np.sqrt(measured.expressions.shape[1])], axis=1)
    chosen = [int(np.linalg.norm(features - features.mean(0), axis=1).argmin())]
    nearest = np.full(len(features), np.inf)
    for _ in range(max(1, round(MIXED_SHARE * len(features))) - 1):
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return sorted(chosen)


def ranges(measured: Measured, chosen: list[int]) -> dict[str, float]:
    """Range of yaw and pitch between their 2nd and 98th percentiles, in degrees, and the mean spread of expressions.

    The spread is 1 for all timesteps together.
    """
    low, high = np.percentile(np.degrees(measured.angles[chosen]), (2, 98), axis=0)
    moving = measured.expressions.std(0) > 0.5
    spread = measured.expressions[chosen][:, moving].std(0).mean() if moving.any() else 0.0
    return {
        "yaw_range": round(float(high[0] - low[0]), 2),
        "pitch_range": round(float(high[1] - low[1]), 2),
        "expression_spread": round(float(spread), 3),
    }


def masks(sequences: list[Sequence], measured: Measured, chosen: list[int]) -> list[Bool[Tensor, " t"]]:
    """The chosen timesteps as a mask for each sequence."""
    found = [torch.zeros(len(one.tracking.face), dtype=torch.bool) for one in sequences]
    for index in chosen:
        sequence, timestep = measured.timesteps[index]
        found[sequence][timestep] = True
    return found
