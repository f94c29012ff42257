"""A gain of three numbers for each timestep, which is learned beside the avatar where the light changes.

A camera with automatic exposure makes a face brighter and darker over time. Without gains, the avatar has to explain
this by poses and expressions, which blotches the skin. The avatar has the mean light of the frames that it is trained
on. What is compared with a picture is the rendering times the gain of the picture's timestep.

Gains are linear in time, in their logarithm, between knots at timesteps that are trained on. So the pixels of a
held-out timestep decide nothing about its own gain.
"""

from collections.abc import Sequence as Items
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.capture import is_light_changing
from mien.errors import UserError
from mien.render.rendering import Rendering
from mien.storage import read_tensors
from mien.training.camera_colors import LearnedColors, recolored
from mien.training.constants import TRAINING
from mien.training.footage import Frame, Sequence
from mien.training.parts import TrainingPart
from mien.training.settings import TrainSettings

GAINS = "gains.safetensors"
"""File of a run with the gains of all timesteps of all sequences. Runs in steady light have none."""
_MOST = 100.0
"""Largest gain that is read, and the inverse of the least."""


class FrameGains:
    """Gains of all timesteps of all sequences, one sequence after the other.

    They start from the brightness of the faces that are trained on. Their logarithms have a mean of 0 over these. A
    sequence that is not trained on has gains of 1.

    Args:
        sequences: The sequences of a run.
        frames: The frames that are trained on.
        rate: Learning rate of the logarithms, per step.
        like: The gains have its dtype and its device.
    """

    def __init__(self, sequences: Items[Sequence], frames: Items[Frame], rate: float, like: Tensor):
        lengths = [sequence.capture.timesteps for sequence in sequences]
        self._starts = [sum(lengths[:index]) for index in range(len(lengths))]
        used = [sorted({one.timestep for one in frames if one.sequence == index}) for index in range(len(lengths))]
        times = [sequence.capture.timestamps for sequence in sequences]
        weights = torch.block_diag(*map(_interpolation, times, used)).numpy()
        trained = sorted({self._starts[frame.sequence] + frame.timestep for frame in frames})
        levels = np.log(_brightness(sequences, frames, sum(lengths))[trained])
        own, known = weights[trained], np.isfinite(levels)
        # A knot starts from the mean of the frames around it.
        near = own[known].T @ (levels[known] - levels[known].mean()) if known.any() else np.zeros(weights.shape[1])
        knots = near / np.maximum(own[known].sum(0), 1e-9)
        lit = weights.sum(1, keepdims=True)  # 0 in sequences that are not trained on, else 1
        self._weights = torch.from_numpy(weights - lit * own.mean(0)).to(like)
        self.learned = LearnedColors("frame_gains", torch.from_numpy(knots).to(like)[:, None].repeat(1, 3), rate)

    def gains(self) -> Float[Tensor, "t 3"]:
        """The gain of each timestep."""
        return (self._weights @ self.learned.values).exp()

    def seen_by(self, rendering: Rendering, background: Float[Tensor, " 3"], frame: Frame) -> Rendering:
        """The rendering of a training frame in its light. The background keeps its colour."""
        row = self._weights[self._starts[frame.sequence] + frame.timestep]
        return lit(rendering, background, (row @ self.learned.values).exp())


def lit(rendering: Rendering, background: Float[Tensor, " 3"], gain: Float[Tensor, " 3"]) -> Rendering:
    """The rendering of an avatar times a gain. The background keeps its colour."""
    return recolored(rendering, background, torch.cat([torch.diag(gain - 1), torch.zeros_like(gain)[:, None]], 1))


def light_changes(sequences: Items[Sequence], frames: Items[Frame]) -> bool:
    """Whether the brightness of the faces that are trained on says that the light changes, in runs of one camera.

    Rigs have several cameras, fixed lamps and fixed exposures.
    """
    if any(len(sequence.capture.camera_ids) > 1 for sequence in sequences):
        return False
    levels = _brightness(sequences, frames, sum(sequence.capture.timesteps for sequence in sequences))
    return is_light_changing(levels)


def frame_gains_part(
    sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor
) -> TrainingPart | None:
    """The gains of a run as a part of its training, or None if the light is steady or the settings ask for none."""
    if settings.light == "steady" or (settings.light == "auto" and not light_changes(sequences, frames)):
        return None
    gains = FrameGains(sequences, frames, settings.camera_color_rate, like)
    return TrainingPart(
        "gains",
        seen=lambda rendering, one: gains.seen_by(rendering, one.target.background, one.frame),
        parameter_groups=gains.learned.parameter_groups,
        state=gains.learned.state,
        load_state=gains.learned.load_state,
        results=lambda: {GAINS: {"gains": gains.gains().detach()}},
    )


def read_gains(run_dir: Path, lengths: Items[int]) -> list[Float[Tensor, "t 3"]]:
    """The gains of each sequence of a finished run. The list is empty if it was trained without any.

    Args:
        run_dir: The run's folder.
        lengths: Number of timesteps of each sequence.

    Raises:
        UserError: they are damaged, or of other sequences.
    """
    path = run_dir / GAINS
    if not path.exists():
        return []
    gains = read_tensors(path).get("gains", torch.zeros(0))
    if gains.shape != (sum(lengths), 3) or not bool(((gains > 1 / _MOST) & (gains < _MOST)).all()):
        raise UserError(f"{path}: does not hold gains of {sum(lengths)} timesteps; train again")
    return list(gains.float().split(list(lengths)))


def _brightness(sequences: Items[Sequence], frames: Items[Frame], timesteps: int) -> Float[np.ndarray, " t"]:
    """The brightness of the face in each timestep that is trained on, the mean over its cameras; NaN elsewhere."""
    sums, counts, starts = np.zeros(timesteps), np.zeros(timesteps), [0]
    for sequence in sequences:
        starts.append(starts[-1] + sequence.capture.timesteps)
    for index, timestep, camera in frames:
        quality = sequences[index].capture.quality
        level = 0.0 if quality is None else float(quality.brightness[timestep, camera])
        if level > 0:  # NaN compares as not brighter.
            sums[starts[index] + timestep] += level
            counts[starts[index] + timestep] += 1
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _interpolation(times: Float[np.ndarray, " t"], used: Items[int]) -> Float[Tensor, "t k"]:
    """The weights of knots at each timestep. Knots are at some of the `used` timesteps, a certain time apart."""
    knots: list[int] = []
    for timestep in used:
        if not knots or times[timestep] - times[knots[-1]] >= TRAINING.gain_interval:
            knots.append(timestep)
    weights = [np.interp(times, times[knots], own) for own in np.eye(len(knots))]
    return torch.from_numpy(np.stack(weights, 1)) if knots else torch.zeros(len(times), 0, dtype=torch.float64)
