"""From folders to experiments: a run, and the sequences that it was trained on."""

from collections.abc import Sequence as Items
from dataclasses import replace
from pathlib import Path

import numpy as np

from mien.avatar import load_avatar
from mien.config import decode
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, FaceSource, Frame
from mien.face import FaceParams
from mien.storage import read_tensors
from mien.tracking import read_scoring
from mien.training import Sequence, TrainSettings, read_run_config, read_sequence
from mien.training.frames import training_frames
from mien.training.split import held_out


def load_experiments(run_dir: Path, sequence_dirs: Items[Path]) -> dict[str, Experiment]:
    """What there is to evaluate, by protocol; nothing where nothing was held out.

    `self_reenactment` (`self_reenactment_tail` for that split) holds the timesteps and sequences that training left
    out, `novel_view` the cameras that it left out, at timesteps it has seen.

    Raises:
        UserError: the run is not finished, or the sequences are not those that it was trained on.
    """
    config = read_run_config(run_dir)
    settings = decode(TrainSettings, config["settings"], str(run_dir / "config.json"))
    wanted = [entry["sequence"] for entry in config["data"]]
    if [folder.name for folder in sequence_dirs] != wanted:
        given = ", ".join(folder.name for folder in sequence_dirs)
        raise UserError(f"{run_dir}: was trained on {', '.join(wanted)}, not on {given}; give it those sequences")
    sequences = tuple(read_sequence(folder) for folder in sequence_dirs)
    faces = _faces_of_run(run_dir, sequences)
    trained = tuple(Frame(f.sequence, f.timestep, f.camera) for f in training_frames(sequences, settings))
    base = Experiment(
        avatar=load_avatar(run_dir),
        sequences=sequences,
        faces=faces,
        face_source="as_tracked",
        scorings=tuple(read_scoring(folder / "scoring") for folder in sequence_dirs),
        training_frames=trained,
        held_out_frames=(),
        split=settings.split,
    )
    return {
        protocol: replace(base, held_out_frames=frames, split=split, face_source=_face_source(sequences, faces, frames))
        for protocol, (split, frames) in _protocols(sequences, settings).items()
    }


def _protocols(sequences: Items[Sequence], settings: TrainSettings) -> dict[str, tuple[str, tuple[Frame, ...]]]:
    """Held-out frames by protocol, each with the name of its split."""
    unseen_timesteps: list[Frame] = []
    unseen_cameras: list[Frame] = []
    whole = bool(settings.held_out_sequences)
    for index, sequence in enumerate(sequences):
        left_out = held_out(sequence.capture.timesteps, settings.split).numpy()
        for timestep, camera in np.argwhere(sequence.usable()).tolist():
            frame = Frame(index, timestep, camera)
            if left_out[timestep] or sequence.name in settings.held_out_sequences:
                unseen_timesteps.append(frame)
            elif sequence.capture.camera_ids[camera] in settings.held_out_cameras:
                unseen_cameras.append(frame)
    name = "self_reenactment_tail" if settings.split == "tail" else "self_reenactment"
    parts = ([] if settings.split == "none" else [settings.split]) + ["sequences"] * whole
    split = "+".join(parts)
    found = {name: (split, tuple(unseen_timesteps)), "novel_view": ("cameras", tuple(unseen_cameras))}
    return {protocol: entry for protocol, entry in found.items() if entry[1]}


def _faces_of_run(run_dir: Path, sequences: Items[Sequence]) -> tuple[FaceParams, ...]:
    """The face parameters that training ended with, one a sequence."""
    tuned = FaceParams(**read_tensors(run_dir / "face_track.safetensors"))
    lengths = [sequence.capture.timesteps for sequence in sequences]
    if len(tuned) != sum(lengths):
        raise UserError(f"{run_dir}: has face parameters of {len(tuned)} timesteps, not {sum(lengths)}; train it again")
    ends = np.cumsum(lengths).tolist()
    return tuple(tuned[end - length : end] for end, length in zip(ends, lengths, strict=True))


def _face_source(sequences: Items[Sequence], faces: Items[FaceParams], frames: Items[Frame]) -> FaceSource:
    """Whether any held-out timestep is not as the tracker left it."""
    for frame in frames:
        tracked, used = sequences[frame.sequence].tracking.face[frame.timestep], faces[frame.sequence][frame.timestep]
        names = ("expression", "joints", "head_rotation", "head_translation")
        if any(not getattr(tracked, name).equal(getattr(used, name)) for name in names):
            return "corrected"
    return "as_tracked"
