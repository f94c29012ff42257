"""Which clips a study shows: parts of the held-out spans that all compared runs share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mien.errors import UserError
from mien.evaluation.experiment import Experiment
from mien.evaluation.load import load_experiments
from mien.lab.analysis.study.settings import StudySettings
from mien.training.footage.frames import Frame

_MIN_FRAMES = 2
_SHORTEST = 0.5
"""Shortest clip of a workspace, as a share of its longest one. The rests of spans are not worth a question."""


@dataclass(frozen=True)
class StudyRuns:
    """The runs of one workspace that a study compares."""

    name: str
    """Name of the workspace."""
    runs: Mapping[str, tuple[Path, tuple[Path, ...]]]
    """The folder of each run and those of its sequences, by the run's label. All workspaces have the same labels."""


@dataclass(frozen=True)
class Clip:
    """Consecutive held-out timesteps of one camera."""

    workspace: int
    sequence: str
    camera_id: str
    first: int
    timesteps: int
    fps: float

    def frames(self) -> list[tuple[str, str, int]]:
        """Sequence, camera and timestep of each frame."""
        return [(self.sequence, self.camera_id, self.first + index) for index in range(self.timesteps)]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The held-out frames of one run, whatever the protocol."""

    frames: Mapping[tuple[str, str, int], tuple[Experiment, Frame]]
    """By sequence, camera and timestep."""


def read_held_out(run_dir: Path, sequence_dirs: Sequence[Path]) -> HeldOut:
    """The held-out frames of a run, with its avatar."""
    experiments = load_experiments(run_dir, sequence_dirs).values()
    frames = {
        (one.sequences[frame.sequence].name, one.camera_id(frame), frame.timestep): (one, frame)
        for one in experiments
        for frame in one.held_out_frames
    }
    return HeldOut(frames)


def choose_clips(workspaces: Sequence[StudyRuns], settings: StudySettings) -> list[Clip]:
    """Random clips, in turn from each workspace, as long as there are any."""
    random = np.random.default_rng(settings.seed)
    left = []
    for index, workspace in enumerate(workspaces):
        found = _pieces(index, workspace, settings.seconds)
        left.append([found[place] for place in random.permutation(len(found))])
    turns = [int(index) for index in random.permutation(len(workspaces))]
    chosen: list[Clip] = []
    while len(chosen) < settings.clips and any(left):
        for index in turns:
            if left[index] and len(chosen) < settings.clips:
                chosen.append(left[index].pop())
    return chosen


def _pieces(index: int, workspace: StudyRuns, seconds: float) -> list[Clip]:
    """The clips of a workspace, without those that are much shorter than others."""
    rates: dict[str, float] = {}
    common: set[tuple[str, str, int]] | None = None
    for run_dir, sequence_dirs in workspace.runs.values():
        # One run at a time, so that memory does not grow with their number.
        held_out = read_held_out(run_dir, sequence_dirs)
        common = set(held_out.frames) if common is None else common & set(held_out.frames)
        for experiment, frame in held_out.frames.values():
            capture = experiment.sequences[frame.sequence].capture
            rates[experiment.sequences[frame.sequence].name] = capture.fps
    places: dict[tuple[str, str], list[int]] = {}
    for sequence, camera_id, timestep in sorted(common or ()):
        places.setdefault((sequence, camera_id), []).append(timestep)
    found = []
    for (sequence, camera_id), timesteps in places.items():
        most = max(_MIN_FRAMES, round(seconds * rates[sequence]))
        for first, count in spans(timesteps, most):
            found.append(Clip(index, sequence, camera_id, first, count, rates[sequence]))
    longest = max((clip.timesteps for clip in found), default=0)
    if longest == 0:
        raise UserError(
            f"{workspace.name}: {', '.join(workspace.runs)} have no held-out frames in a row in common; train them "
            "with the same --split or --hold-out"
        )
    return [clip for clip in found if clip.timesteps >= _SHORTEST * longest]


def spans(timesteps: Sequence[int], most: int) -> list[tuple[int, int]]:
    """Runs of consecutive timesteps, cut into about equal parts of at most `most`: the first one and the number.

    Parts of a single timestep are left out. `timesteps` are sorted.
    """
    found: list[tuple[int, int]] = []
    for part in np.split(np.array(timesteps), np.flatnonzero(np.diff(timesteps) != 1) + 1):
        pieces = np.array_split(part, -(-len(part) // most))
        found += [(int(piece[0]), len(piece)) for piece in pieces if len(piece) >= _MIN_FRAMES]
    return found
