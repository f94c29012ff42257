"""Colours that are learned beside the avatar and used only in training: of each camera, and of each timestep's light.

Cameras of a rig differ in exposure and white balance, and a camera with automatic exposure makes a face brighter and
darker over time. Without transforms, the avatar has to explain this by colours that depend on the view, by fog in front
of a camera, or by poses and expressions, which blotches the skin.

Gains of timesteps are linear in time, in their logarithm, between knots at timesteps that are trained on. So the pixels
of a held-out timestep decide nothing about its own gain. The avatar has the mean light of the frames that it is trained
on. What is compared with a picture is the rendering times the gain of the picture's timestep.
"""

from collections.abc import Sequence as Items
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.adam import Moments
from mien.avatar.avatar import ParameterGroup
from mien.avatar.settings import Rate
from mien.capture.quality import is_light_changing
from mien.disk.files import read_tensors
from mien.disk.reading import expect_whole
from mien.errors import UserError
from mien.gaussians import Rendering
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence
from mien.training.settings import TrainSettings

COLOR_RATE = 1e-3  # learning rate of the cameras' colours, and of gains, at the first step
_LAST_SHARE = 0.1  # the same at the last step, as a share of that at the first


class LearnedColors:
    """Numbers of colours that are learned beside the avatar, with their own state of the optimiser."""

    def __init__(self, name: str, values: Tensor):
        self.values = values.detach().clone().requires_grad_()
        self.name, self._rate = name, Rate(COLOR_RATE, _LAST_SHARE * COLOR_RATE)
        self._moments = {"changes": Moments.zeros(values)}

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group of all numbers."""
        return [ParameterGroup(self.name, {"changes": self.values}, self._rate, {**self._moments})]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save. They share memory with the numbers."""
        moments = self._moments["changes"]
        return {
            "changes": self.values.detach(), "changes.first": moments.first, "changes.second": moments.second,
            "changes.step": moments.step,
        }  # fmt: skip

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        for name, own in self.state().items():
            own.copy_(state[name])


def recolored(rendering: Rendering, background: Float[Tensor, " 3"], change: Float[Tensor, "3 4"]) -> Rendering:
    """The rendering with other colours: `change` adds a matrix times the colour, and an offset.

    The background keeps its colour.
    """
    alpha = rendering.alpha[..., None]
    foreground = rendering.image - (1 - alpha) * background
    return replace(rendering, image=rendering.image + foreground @ change[:, :3].T + alpha * change[:, 3])


class CameraColors:
    """An affine map of colours for each camera id that is trained on. All start as the identity."""

    def __init__(self, sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor):
        trained = {(frame.sequence, frame.camera) for frame in frames}
        ids = dict.fromkeys(sequences[index].capture.camera_ids[camera] for index, camera in sorted(trained))
        if len(ids) < 2:
            raise UserError(
                f"--training.camera-colors {settings.camera_colors}: compares cameras, and this run trains on "
                f"{', '.join(ids)} alone; leave the option out"
            )
        self._first_is_right = settings.camera_colors == "first"
        self.ids = tuple(ids)
        """The cameras, in the order of the maps."""
        self.learned = LearnedColors("colors", like.new_zeros(len(ids), 3, 4))
        places = {camera_id: place for place, camera_id in enumerate(ids)}
        self._places = [[places.get(camera_id, 0) for camera_id in one.capture.camera_ids] for one in sequences]

    def changes(self) -> Float[Tensor, "c 3 4"]:
        """What each camera's map adds to a colour: a matrix, then an offset. That of the right one is zero."""
        changes = self.learned.values
        return changes - (changes[:1] if self._first_is_right else changes.mean(0, keepdim=True))

    def seen_by(self, rendering: Rendering, background: Float[Tensor, " 3"], frame: Frame) -> Rendering:
        """The rendering of a training frame in its camera's colours. The background keeps its colour."""
        return recolored(rendering, background, self.changes()[self._places[frame.sequence][frame.camera]])


def camera_colors(
    sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor
) -> CameraColors | None:
    """The colour transforms of a run, or None if its settings ask for none."""
    return None if settings.camera_colors == "none" else CameraColors(sequences, frames, settings, like)


_GAIN_INTERVAL = 0.1  # time in seconds between knots of the gains of timesteps. Automatic exposure takes longer

GAINS = "gains.safetensors"
"""File of a run with the gains of all timesteps of all sequences. Runs in steady light have none."""


class FrameGains:
    """Gains of all timesteps of all sequences, one sequence after the other.

    They start from the brightness of the faces that are trained on. Their logarithms have a mean of 0 over these. A
    sequence that is not trained on has gains of 1.
    """

    def __init__(self, sequences: Items[Sequence], frames: Items[Frame], like: Tensor):
        lengths = [sequence.capture.timesteps for sequence in sequences]
        self._starts = [sum(lengths[:index]) for index in range(len(lengths))]
        used = [sorted({one.timestep for one in frames if one.sequence == index}) for index in range(len(lengths))]
        times = [sequence.capture.timestamps for sequence in sequences]
        parts = [_between(*each) for each in zip(times, used, strict=True)]
        counts = [count for *_, count in parts]
        firsts = np.cumsum([0, *counts])
        # The knots before and after each timestep, and their shares. Both shares are 0 in sequences without knots.
        places = np.concatenate([first + place for first, (place, _, _) in zip(firsts, parts, strict=False)])
        shares = np.concatenate([share for _, share, _ in parts])
        places = np.minimum(places, firsts[-1] - 1)
        trained = sorted({self._starts[frame.sequence] + frame.timestep for frame in frames})
        levels = np.log(_brightness(sequences, frames, sum(lengths))[trained])
        known = np.isfinite(levels)
        differences = np.where(known, levels - (levels[known].mean() if known.any() else 0), 0)
        usual, around, seen = np.zeros(firsts[-1]), np.zeros(firsts[-1]), np.zeros(firsts[-1])
        np.add.at(usual, places[trained], shares[trained] / len(trained))
        # A knot starts from the mean of the frames around it.
        np.add.at(around, places[trained], shares[trained] * differences[:, None])
        np.add.at(seen, places[trained], shares[trained] * known[:, None])
        knots = torch.from_numpy(around / np.maximum(seen, 1e-9)).to(like)
        self._places, self._shares = torch.from_numpy(places).to(like.device), torch.from_numpy(shares).to(like)
        self._usual = torch.from_numpy(usual).to(like)
        self._trained = torch.from_numpy(shares.sum(1, keepdims=True)).to(like)
        self.learned = LearnedColors("gains", knots[:, None].repeat(1, 3))

    def _at(self, index: int | slice) -> Float[Tensor, "n 3"]:
        """The logarithms of the gains of some timesteps."""
        values, some = self.learned.values, [index] if isinstance(index, int) else index
        own = (values[self._places[some]] * self._shares[some][..., None]).sum(1)
        return own - self._trained[some] * (self._usual @ values)

    def gains(self) -> Float[Tensor, "t 3"]:
        """The gain of each timestep."""
        return self._at(slice(None)).exp()

    def seen_by(self, rendering: Rendering, background: Float[Tensor, " 3"], frame: Frame) -> Rendering:
        """The rendering of a training frame in its light. The background keeps its colour."""
        return lit(rendering, background, self._at(self._starts[frame.sequence] + frame.timestep)[0].exp())


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


def frame_gains(
    sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor
) -> FrameGains | None:
    """The gains of a run, or None if the light is steady or the settings ask for none."""
    if settings.light == "steady" or (settings.light == "auto" and not light_changes(sequences, frames)):
        return None
    return FrameGains(sequences, frames, like)


_MOST = 100.0  # largest gain, and inverse of the smallest, that a run may hold


def read_gains(run_dir: Path, lengths: Items[int]) -> list[Float[Tensor, "t 3"]]:
    """The gains of each sequence of a finished run. The list is empty if it was trained without any."""
    path = run_dir / GAINS
    if not path.exists() and not path.is_symlink():
        return []
    with expect_whole(path, "train again"):
        gains = read_tensors(path)["gains"]
        if gains.shape != (sum(lengths), 3) or gains.dtype.itemsize < 4:
            raise ValueError(f"the gains have the shape {tuple(gains.shape)} and the type {gains.dtype}")
        if not bool(((gains > 1 / _MOST) & (gains < _MOST)).all()):
            raise ValueError(f"a gain is not a number from {1 / _MOST:g} to {_MOST:g}")
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


def _between(
    times: Float[np.ndarray, " t"], used: Items[int]
) -> tuple[Int[np.ndarray, "t 2"], Float[np.ndarray, "t 2"], int]:
    """The two knots around each timestep, their shares, and the number of knots.

    Knots are at some of the `used` timesteps, a certain time apart. Before the first and after the last, only that one
    counts. Without any, all shares are 0.
    """
    knots: list[int] = []
    for timestep in used:
        if not knots or times[timestep] - times[knots[-1]] >= _GAIN_INTERVAL:
            knots.append(timestep)
    if not knots:
        return np.zeros((len(times), 2), np.int64), np.zeros((len(times), 2)), 0
    position = np.interp(times, times[knots], np.arange(len(knots)))
    before = np.floor(position).astype(np.int64)
    after = np.minimum(before + 1, len(knots) - 1)
    share = position - before
    return np.stack([before, after], 1), np.stack([1 - share, share], 1), len(knots)
