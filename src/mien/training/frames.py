"""Which frame a step looks at: every draw is a function of the seed and the step, so that runs resume exactly."""

import hashlib
from collections.abc import Sequence as Items
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from mien.errors import UserError
from mien.training.sequence import Sequence
from mien.training.settings import TrainSettings
from mien.training.split import held_out

_ORDER, _BACKGROUND, _DENSITY = range(3)


@dataclass(frozen=True)
class Frame:
    """One picture to train on."""

    sequence: int
    """Index into the run's sequences."""
    timestep: int
    camera: int
    track_index: int
    """Of the timestep among those of all sequences in a row."""


FRAME_ROLES = ("training", "self_reenactment", "self_reenactment_sequence", "novel_view", "unused")
"""What a usable frame is for; see `frames_by_role`."""


def frames_by_role(sequences: Items[Sequence], settings: TrainSettings) -> dict[str, list[Frame]]:
    """All usable frames of a run by what they are for (each is in one list, any list may be empty).

    - `training`: what steps look at.
    - `self_reenactment`: timesteps that the split holds out, in cameras that are trained on.
    - `self_reenactment_sequence`: all timesteps of sequences that are held out as a whole, in the same cameras. The
      split divides only the sequences that are trained on.
    - `novel_view`: held-out cameras, at timesteps that other cameras show in training.
    - `unused`: held-out cameras at held-out timesteps (two questions at once), and blurred frames that would have been
      trained on. Blurred frames that are held out are scored: avatars of one recipe and another see the same ones.
    """
    roles: dict[str, list[Frame]] = {role: [] for role in FRAME_ROLES}
    start = 0
    for index, sequence in enumerate(sequences):
        whole = sequence.name in settings.held_out_sequences
        left_out, sharp = held_out(sequence.capture.timesteps, settings.split).numpy(), sequence.sharp()
        for timestep, camera in np.argwhere(sequence.usable()).tolist():
            new_view = sequence.capture.camera_ids[camera] in settings.held_out_cameras
            new_time = whole or bool(left_out[timestep])
            role = "training" if sharp[timestep, camera] else "unused"
            if new_view:
                role = "unused" if new_time else "novel_view"
            elif new_time:
                role = "self_reenactment_sequence" if whole else "self_reenactment"
            roles[role].append(Frame(index, timestep, camera, start + timestep))
        start += sequence.capture.timesteps
    return roles


def training_frames(sequences: Items[Sequence], settings: TrainSettings) -> list[Frame]:
    """All frames that are usable and not held out.

    Raises:
        UserError: there is none, or what is to be held out is not there.
    """
    names = [sequence.name for sequence in sequences]
    check_held_out(names, settings)
    ids = dict.fromkeys(camera_id for sequence in sequences for camera_id in sequence.capture.camera_ids)
    unknown = [camera_id for camera_id in settings.held_out_cameras if camera_id not in ids]
    if unknown:
        raise UserError(f"--hold-out-cameras {unknown[0]}: no such camera; there are: {', '.join(ids)}")
    frames = frames_by_role(sequences, settings)["training"]
    if not frames:
        raise UserError(
            f"{', '.join(names)}: no frame to train on with split {settings.split!r} and what is held out; "
            "a longer clip, --split none, or hold out less"
        )
    return frames


def check_held_out(names: Items[str], settings: TrainSettings) -> None:
    """Find that the sequences to be held out are among a run's, and that others remain.

    Raises:
        UserError: they are not, or nothing remains.
    """
    unknown = [name for name in settings.held_out_sequences if name not in names]
    if unknown:
        raise UserError(f"--hold-out {unknown[0]}: no such sequence in this run; there are: {', '.join(names)}")
    if set(names) <= set(settings.held_out_sequences):
        raise UserError(f"--hold-out {' '.join(settings.held_out_sequences)}: leaves no sequence to train on")


class FrameOrder:
    """Shuffled passes over the training frames."""

    def __init__(self, frames: Items[Frame], seed: int):
        self._frames = frames
        self._seed = seed
        self._epoch = -1
        self._order: list[int] = []

    def at(self, step: int) -> tuple[Frame, int]:
        """The frame of a step and the number of passes completed before it."""
        epoch = step // len(self._frames)
        if epoch != self._epoch:
            generator = random_at(self._seed, _ORDER, epoch)
            self._order = torch.randperm(len(self._frames), generator=generator).tolist()
            self._epoch = epoch
        return self._frames[self._order[step % len(self._frames)]], epoch


def background_at(settings: TrainSettings, step: int) -> UInt8[np.ndarray, " 3"]:
    """The background colour of a step."""
    if settings.background == "white":
        return np.full(3, 255, dtype=np.uint8)
    generator = random_at(settings.seed, _BACKGROUND, step)
    return torch.randint(256, (3,), generator=generator).numpy().astype(np.uint8)


def density_random(settings: TrainSettings, step: int) -> torch.Generator:
    """The random numbers of a step's density control."""
    return random_at(settings.seed, _DENSITY, step)


def random_at(seed: int, purpose: int, step: int) -> torch.Generator:
    """A generator that depends on these three numbers only."""
    # torch's CPU generator looks at the low 32 bits of its seed only, so the three have to be mixed into them.
    digest = hashlib.blake2b(f"{seed} {purpose} {step}".encode(), digest_size=4).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little"))
