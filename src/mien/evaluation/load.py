"""Loads experiments from folders: a run, and the sequences that it was trained on."""

from collections.abc import Sequence as Items
from dataclasses import replace
from pathlib import Path

import numpy as np

from mien.avatar.files import load_avatar
from mien.capture.store import read_capture_hash
from mien.disk.config import decode
from mien.errors import UserError
from mien.evaluation.dataset_protocols import counted_frames, dataset_protocol, scores_whole_mattes
from mien.evaluation.experiment import Edges, Experiment, FaceSource
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.tracking.scoring_files import read_scoring, read_scoring_hash
from mien.training.colors import read_gains
from mien.training.footage.clothes import clothes_digest, read_clothes
from mien.training.footage.frames import Frame, held_out_of, training_frames
from mien.training.footage.sequence import Sequence, sequence_of
from mien.training.run import check_data, read_face_track, read_run_config
from mien.training.settings import TrainSettings


def load_experiments(
    run_dir: Path, sequence_dirs: Items[Path], edges: Edges = "cleaned", protocol: str | None = None
) -> dict[str, Experiment]:
    """The experiments of a run, by protocol. The result is empty if nothing was held out.

    - `self_reenactment` (`self_reenactment_tail` for that split): held-out timesteps of the training sequences.
    - `self_reenactment_sequence`: whole held-out sequences, with the mean correction of the head's pose.
    - `novel_view`: held-out cameras, at timesteps that were trained with other cameras.

    The first two include all cameras, also held-out ones. `edges` says what the truth is at soft edges.
    With the name of a dataset's `protocol`, the pixels and frames of its authors are scored.
    """
    config = read_run_config(run_dir)
    settings = decode(TrainSettings, config["settings"], str(run_dir / "config.json"), "train it again")
    wanted = [entry["sequence"] for entry in config["data"]]
    if [folder.name for folder in sequence_dirs] != wanted:
        given = ", ".join(folder.name for folder in sequence_dirs)
        raise UserError(f"{run_dir}: was trained on {', '.join(wanted)}, not on {given}; give it those sequences")
    digests = tuple(_digests(folder) for folder in sequence_dirs)
    scorings = tuple(read_scoring(each / "scoring", read_capture_hash(each / "capture")) for each in sequence_dirs)
    rules, whole = None if protocol is None else dataset_protocol(protocol), False
    if rules is not None:
        masks = dict(zip(sequence_dirs, scorings, strict=True))
        whole = scores_whole_mattes(rules, run_dir, masks, settings.split)
    sequences = tuple(sequence_of(folder, scoring) for folder, scoring in zip(sequence_dirs, scorings, strict=True))
    for folder, digest in zip(sequence_dirs, digests, strict=True):
        if _digests(folder) != digest:
            raise UserError(f"{folder}: was changed while it was read; run the same command again")
    check_data(run_dir, {sequence.name: sequence.tracking for sequence in sequences})
    shapes = ((mattes.shape[0], *mattes.shape[2:]) for mattes in (sequence.capture.mattes for sequence in sequences))
    clothes = tuple(map(read_clothes, sequence_dirs, shapes)) if rules is not None and rules.opened else ()
    scored = [{**each, **({"mask": "matte"} if whole else {})} for each in digests]
    for each, packed in zip(scored, clothes, strict=False):
        each |= {} if packed is None else {"clothes": clothes_digest(packed)}
    avatar = load_avatar(run_dir)
    for folder, sequence in zip(sequence_dirs, sequences, strict=True):
        check_face_params(avatar.face_model, sequence.tracking.face, str(folder), "track it again")
    faces = _faces_of_run(run_dir, sequences, avatar.face_model)
    base = Experiment(
        avatar=avatar,
        sequences=sequences,
        faces=faces,
        face_source="as_tracked",
        scorings=scorings,
        training_frames=tuple(training_frames(sequences, settings)),
        held_out_frames=(),
        split=settings.split,
        edges=edges,
        whole_mattes=whole,
        clothes=clothes,
        gains=tuple(read_gains(run_dir, [sequence.capture.timesteps for sequence in sequences])),
        digests=tuple(scored),
    )
    found = held_out_by_protocol(sequences, settings)
    if rules is not None:
        found = counted_frames(sequences, settings.split, found)
    return {
        name: replace(base, held_out_frames=frames, split=split, face_source=_face_source(sequences, faces, frames))
        for name, (split, frames) in found.items()
    }


def _digests(folder: Path) -> dict[str, str]:
    return {"pictures": read_capture_hash(folder / "capture"), "mask": read_scoring_hash(folder / "scoring")}


def held_out_by_protocol(
    sequences: Items[Sequence], settings: TrainSettings
) -> dict[str, tuple[str, tuple[Frame, ...]]]:
    """Held-out frames by protocol, each with the name of its split. Protocols without a frame are left out."""
    unseen_timesteps: list[Frame] = []
    unseen_sequences: list[Frame] = []
    unseen_cameras: list[Frame] = []
    for index, sequence in enumerate(sequences):
        left_out = held_out_of(sequence, settings.split).numpy()
        trained_cameras = [camera_id not in settings.held_out_cameras for camera_id in sequence.capture.camera_ids]
        sharp = sequence.usable() & sequence.sharp()
        seen = np.any(sharp & np.array(trained_cameras), axis=1).tolist()
        for timestep, camera in np.argwhere(sequence.usable()).tolist():
            frame = Frame(index, timestep, camera)
            if sequence.name in settings.held_out_sequences:
                unseen_sequences.append(frame)
            elif left_out[timestep]:
                unseen_timesteps.append(frame)
            elif not trained_cameras[camera] and seen[timestep]:
                unseen_cameras.append(frame)
    by_time = "self_reenactment_tail" if settings.split == "tail" else "self_reenactment"
    found = {
        by_time: (settings.split, tuple(unseen_timesteps)),
        "self_reenactment_sequence": ("sequences", tuple(unseen_sequences)),
        "novel_view": ("cameras", tuple(unseen_cameras)),
    }
    return {protocol: entry for protocol, entry in found.items() if entry[1]}


def _faces_of_run(run_dir: Path, sequences: Items[Sequence], face_model: FaceModel) -> tuple[FaceParams, ...]:
    """The face parameters at the end of training, one entry per sequence."""
    tuned = read_face_track(run_dir, face_model)
    lengths = [sequence.capture.timesteps for sequence in sequences]
    if len(tuned) != sum(lengths):
        raise UserError(f"{run_dir}: has face parameters of {len(tuned)} timesteps, not {sum(lengths)}; train it again")
    ends = np.cumsum(lengths).tolist()
    return tuple(tuned[end - length : end] for end, length in zip(ends, lengths, strict=True))


def _face_source(sequences: Items[Sequence], faces: Items[FaceParams], frames: Items[Frame]) -> FaceSource:
    """Whether the face parameters of any held-out timestep differ from the tracker's."""
    for frame in frames:
        tracked, used = sequences[frame.sequence].tracking.face[frame.timestep], faces[frame.sequence][frame.timestep]
        names = ("expression", "joints", "head_rotation", "head_translation")
        if any(not getattr(tracked, name).equal(getattr(used, name)) for name in names):
            return "corrected"
    return "as_tracked"
