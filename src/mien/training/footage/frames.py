"""Which frames are held out, and which frame each step trains on.

Every random draw depends only on the seed and the step, so that runs resume exactly.
"""

import hashlib
from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.training.footage.sequence import Sequence, Target
from mien.training.settings import Split, TrainSettings, check_held_out
from mien.training.settings.splits import SPLITS

_EXTENT_MARGIN = 1.1
"""Factor on the largest distance of a camera from the mean of all. Of 3D Gaussian Splatting's published code."""
LEAST_EXTENT = 0.5
"""Least extent of the training cameras, in metres. A single fixed camera has an extent of 0: centres would not move,
and every Gaussian would be too large. Geometry: half a metre is less than a ring of cameras around a head, and more
than the head. One metre would be above the rig of GaussianAvatars' paper."""
_MIXED_SHARE = 0.1
"""Share of the steps in which a mixed background has a random colour. Measured on wojtek, 12,000 steps with alpha
compared at full weight (log, 11-28): 0.1 has 30.4 dB of the head over white and 29.2 over dark blue, 0 has 30.4 and
28.7, and d3 has pale specks on the cheeks from the side; 0.3 with a fifth of the weight has 30.0 and 28.8."""
_RARITY_LIMIT = 2.0  # largest factor by which rare frames are drawn more often, and common ones less
_RARITY_MOST_NEIGHBORS = 100  # largest number of neighbours in which a frame's rarity is measured

Item = TypeVar("Item")
ORDER, BACKGROUND, DENSITY, CROP, COVER, SIDE_VIEW = range(6)
"""Purposes of random numbers: frames, backgrounds, density control, crops of the perceptual loss, hidden Gaussians."""


class Frame(NamedTuple):
    """One picture: the indices of one of the run's sequences, of a timestep in it, and of the camera."""

    sequence: int
    timestep: int
    camera: int


@dataclass(frozen=True, eq=False)
class Footage:
    """The frames that a run trains on, on the CPU in float32."""

    face_model: FaceModel
    sequences: Items[Sequence]
    faces: Items[FaceParams]
    """Face parameters of each sequence, with all its timesteps."""
    frames: Items[Frame]

    def face(self, frame: Frame) -> FaceParams:
        """The face in a frame."""
        return self.faces[frame.sequence][frame.timestep]

    def vertices(self, frame: Frame) -> Float[Tensor, "v 3"]:
        """The posed mesh in a frame, in world space, in metres."""
        return self.face_model(self.face(frame))[0]

    def camera(self, frame: Frame) -> Camera:
        """The camera of a frame."""
        return self.sequences[frame.sequence].tracking.cameras[frame.camera]

    def matte(self, frame: Frame) -> UInt8[np.ndarray, "h w"]:
        """Opacity of the person, not cut at the neck."""
        return np.asarray(self.sequences[frame.sequence].capture.mattes[frame[1:]])

    def scoring(self, frame: Frame) -> UInt8[np.ndarray, "h w"]:
        """Opacity of the pixels that count."""
        return np.array(self.sequences[frame.sequence].scoring[frame[1:]])


@dataclass(frozen=True, eq=False)
class BatchFrame:
    """One frame of a step."""

    number: int
    """Number of frames that the run used before it."""
    frame: Frame
    index: int
    """Its timestep in the track."""
    face: FaceParams
    camera: Camera
    """Its camera, at the size of the target."""
    camera_on_cpu: Camera
    """The same in the memory of the CPU."""
    target: Target
    goal: Callable[[], Any] | None
    """Makes the goal of the perceptual loss. None if the frame is compared without that loss."""


def held_out(timesteps: int, split: Split, folder: Path | None = None) -> Bool[Tensor, " t"]:
    """Which timesteps of a sequence are held out for testing. A folder is needed for the split of its dataset."""
    mask = torch.zeros(timesteps, dtype=torch.bool)
    for start, stop in SPLITS[split].timesteps(timesteps, folder):
        mask[start:stop] = True
    return mask


def held_out_of(sequence: Sequence, split: Split) -> Bool[Tensor, " t"]:
    """Which timesteps of a sequence are held out."""
    return held_out(sequence.capture.timesteps, split, sequence.folder)


def training_frames(sequences: Items[Sequence], settings: TrainSettings) -> list[Frame]:
    """All frames that are usable, sharp, and not held out by their timestep, their sequence or their camera.

    Frames in which something covers a part of the face are left out as well, unless no others are left. The split
    divides each sequence that is trained on. A held-out sequence or camera is held out at all timesteps.
    """
    names = [sequence.name for sequence in sequences]
    check_held_out(names, settings)
    if SPLITS[settings.split].of_cameras and not (settings.held_out_sequences or settings.held_out_cameras):
        raise UserError(
            f"--split {settings.split}: what it holds out is not filled in; train with `mien train`, or give the "
            "result of mien.training.settings.splits.fill_in"
        )
    ids = dict.fromkeys(camera_id for sequence in sequences for camera_id in sequence.capture.camera_ids)
    unknown = [camera_id for camera_id in settings.held_out_cameras if camera_id not in ids]
    if unknown:
        raise UserError(f"--hold-out-cameras {unknown[0]}: no such camera; there are: {', '.join(ids)}")
    frames = []
    for index, sequence in enumerate(sequences):
        usable = sequence.usable() & sequence.sharp()
        usable = usable & ~held_out_of(sequence, settings.split).numpy()[:, None]
        cameras = [camera_id not in settings.held_out_cameras for camera_id in sequence.capture.camera_ids]
        if sequence.name not in settings.held_out_sequences:
            frames += [Frame(index, int(t), int(c)) for t, c in np.argwhere(usable & np.array(cameras))]
    clear = [sequence.clear() for sequence in sequences]
    frames = [frame for frame in frames if clear[frame.sequence][frame.timestep, frame.camera]] or frames
    if not frames:
        places = [str(sequence.folder or sequence.name) for sequence in sequences]
        raise UserError(
            f"{', '.join(places)}: no frame is left to train on with --split {settings.split} and what is held out; "
            "use a longer clip or --split none, or hold out less"
        )
    return frames


def camera_extent(sequences: Items[Sequence], frames: Items[Frame]) -> float:
    """The extent of the cameras that some frames were seen by, in metres, and at least `FOOTAGE.least_extent`.

    It is 1.1 x the largest distance of a camera from the mean of all cameras (3D Gaussian Splatting, published code).
    Each camera of each sequence counts once.
    """
    seen = sorted({(frame.sequence, frame.camera) for frame in frames})
    centers = torch.stack([sequences[index].tracking.cameras[camera].position for index, camera in seen]).double()
    distances = (centers - centers.mean(0)).norm(dim=-1)
    return max(LEAST_EXTENT, _EXTENT_MARGIN * float(distances.max()))


def evenly_spread(items: Items[Item], max_count: int) -> list[Item]:
    """At most `max_count` of the items, evenly spread, always with the first one. With 0, all of them."""
    stride = max(1, -(-len(items) // max_count)) if max_count else 1
    return list(items[::stride])


def spread_frames(frames: Items[Frame], max_count: int) -> list[Frame]:
    """At most `max_count` of the frames, evenly spread over sequences, cameras and time. With 0, all of them."""
    # Sort by camera first: a stride over the cameras of each timestep could always select the same one.
    ordered = sorted(frames, key=lambda frame: (frame.sequence, frame.camera, frame.timestep))
    return evenly_spread(ordered, max_count)


def expression_rarity(sequences: Items[Sequence], frames: Items[Frame]) -> Float[Tensor, " n"]:
    """How often to draw each frame by how rare its expression is: 0.5 to 2, relative to the median timestep.

    The measure is the distance, in tracked expression coefficients, to the k-th nearest timestep of all frames, where
    k is the square root of their number (at most 100). It is large if few timesteps have a similar expression.
    """
    timesteps = sorted({(frame.sequence, frame.timestep) for frame in frames})
    expressions = torch.stack([sequences[s].tracking.face.expression[t] for s, t in timesteps]).double()
    neighbor = min(max(1, round(len(timesteps) ** 0.5)), _RARITY_MOST_NEIGHBORS, len(timesteps) - 1)
    # In rows of bounded memory. Without matrix products, equal expressions are exactly 0 apart.
    rows = (
        torch.cdist(some, expressions, compute_mode="donot_use_mm_for_euclid_dist") for some in expressions.split(512)
    )
    distances = torch.cat([row.kthvalue(neighbor + 1, dim=1).values for row in rows])
    rarity = (distances / distances.median().clamp_min(1e-9)).clamp(1 / _RARITY_LIMIT, _RARITY_LIMIT)
    index = {timestep: number for number, timestep in enumerate(timesteps)}
    return rarity[[index[frame.sequence, frame.timestep] for frame in frames]]


class FrameOrder:
    """Shuffled passes over the training frames.

    `weights` say how often each frame is drawn, relative to the others: a pass has every frame as often as its share
    says, rounded down or up at random. None draws every frame once.
    """

    def __init__(self, frames: Items[Frame], seed: int, weights: Float[Tensor, " n"] | None = None):
        self._frames = frames
        self._seed = seed
        self._ends = None if weights is None else weights.cumsum(0) * (len(frames) / weights.sum())
        self._epoch = -1
        self._order: list[int] = []

    def at(self, step: int) -> tuple[Frame, int]:
        """The frame of a step and the number of passes completed before it."""
        epoch = step // len(self._frames)
        if epoch != self._epoch:
            generator = random_at(self._seed, ORDER, epoch)
            order = torch.randperm(len(self._frames), generator=generator)
            if self._ends is not None:
                # One random shift for evenly spaced points: each frame owns an interval as long as its share.
                shift = torch.rand((), generator=generator, dtype=torch.float64)
                points = torch.arange(len(self._frames), dtype=torch.float64) + shift
                drawn = torch.searchsorted(self._ends.double(), points, right=True)
                order = drawn.clamp_max(len(self._frames) - 1)[order]
            self._order = order.tolist()
            self._epoch = epoch
        return self._frames[self._order[step % len(self._frames)]], epoch


def background_at(settings: TrainSettings, step: int) -> UInt8[np.ndarray, " 3"]:
    """The background colour of a step, 0 to 255."""
    if settings.background == "white":
        return np.full(3, 255, dtype=np.uint8)
    *color, high, low = _random_bytes(settings.seed, BACKGROUND, step, 5)
    drawn = settings.background == "random" or 256 * high + low < 65536 * _MIXED_SHARE
    return np.array(color if drawn else [255] * 3, dtype=np.uint8)


def random_at(seed: int, purpose: int, step: int) -> torch.Generator:
    """A generator that depends only on these three numbers."""
    # torch's CPU generator uses only the low 32 bits of its seed, so the three numbers are hashed into them.
    return torch.Generator().manual_seed(int.from_bytes(_random_bytes(seed, purpose, step, 4), "little"))


def _random_bytes(seed: int, purpose: int, step: int, count: int) -> bytes:
    """Bytes that depend only on these numbers."""
    return hashlib.blake2b(f"{seed} {purpose} {step}".encode(), digest_size=count).digest()
