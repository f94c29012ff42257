"""All frames aligned again, to a quick avatar of the person: analysis by synthesis.

Tracking fits a face model that has one texture. A trained avatar knows the person better: hair, ears, teeth, glasses.
So a quick avatar, the template, is trained on the training frames. Then the face parameters of each frame move until
the template, which stays as it is, looks like the picture. This is tracking: a held-out frame is looked at for its own
face parameters, as in every fit to pixels, and reaches no avatar.
"""

from collections.abc import Iterator
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from mien.avatar import DEFAULT_METHOD, Avatar, FaceTuning, Progress, Rate, frozen
from mien.config import overlay
from mien.face import FaceModel, FaceParams, concatenate
from mien.progress import progress_bar
from mien.render.rasterize import rasterize_each
from mien.threads import one_torch_thread
from mien.training.adam import Adam
from mien.training.alignment_settings import AlignmentSettings
from mien.training.constants import TRAINING
from mien.training.face_track import FaceTrack, corrected_poses, pose_corrections
from mien.training.footage import Sequence, Targets
from mien.training.photometric import photometric_loss
from mien.training.run import read_face_track
from mien.training.settings import PRESETS, TrainSettings
from mien.training.trainer import ProgressBar, train

_WHITE = np.full(3, 255, np.uint8)


@dataclass(frozen=True, eq=False)
class _View:
    """One picture, and which timestep of its batch it belongs to."""

    place: int
    targets: Targets
    timestep: int
    camera: int


def align(
    sequences: Items[Sequence],
    face_model: FaceModel,
    settings: AlignmentSettings,
    training: TrainSettings,
    folder: Path,
    progress: ProgressBar = progress_bar,
) -> list[FaceParams]:
    """Train a template and align all frames of some sequences of one subject to it.

    Identity and offsets of the mesh stay. So does the mean of head poses, as Gaussians and poses could move together.

    Args:
        sequences: The sequences. `training` says what of them is held out.
        face_model: The face model that they were tracked with.
        settings: Settings of the template and of the alignment.
        training: Settings of the run that the alignment is for. Its split, seed, device and threads are used.
        folder: Where the template is trained. A stopped training continues there.
        progress: Makes progress bars.

    Returns:
        The face parameters of each sequence.

    Raises:
        UserError: as `mien.training.trainer.train`.
    """
    config = overlay(
        PRESETS["draft"].config(DEFAULT_METHOD),
        {"density": {"max_gaussians": settings.template_gaussians}},
        "template",
        DEFAULT_METHOD,
    )
    # Only filmed views are drawn, so sides need no fill, and the colours of a fixed background disturb nothing.
    how = replace(
        training,
        steps=settings.template_steps,
        resolution=settings.resolution,
        background="white",
        edges="cleaned",
        unseen="trained",
        mesh="tracked",
    )

    def titled(title: str, total: int, completed: int):  # noqa: ANN202
        return progress(f"template: {title}", total, completed)

    template = train(sequences, face_model, config, how, folder, titled)
    lengths = [len(sequence.tracking.face) for sequence in sequences]
    starts = _split(read_face_track(folder, face_model), lengths)
    aligned = align_faces(template, sequences, starts, settings, training.held_out_cameras, progress)
    return [steadier(sequence.tracking.face, face) for sequence, face in zip(sequences, aligned, strict=True)]


def steadier(tracked: FaceParams, aligned: FaceParams) -> FaceParams:
    """The aligned face parameters of a sequence, with corrections of the head's pose that are averaged over time.

    Each frame is aligned on its own, which makes heads tremble. A tracking's errors change slowly, so its corrections
    are averaged over three timesteps. Expressions stay, since averaging them costs detail.
    """
    corrections = pose_corrections(tracked, aligned)
    padded = torch.cat([corrections[:1], corrections, corrections[-1:]])
    corrections = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    poses = corrected_poses(tracked, corrections)
    return replace(aligned, head_rotation=poses.head_rotation, head_translation=poses.head_translation)


def align_faces(
    avatar: Avatar,
    sequences: Items[Sequence],
    starts: Items[FaceParams],
    settings: AlignmentSettings,
    held_out_cameras: Items[str] = (),
    progress: ProgressBar = progress_bar,
) -> list[FaceParams]:
    """Return the face parameters of each sequence with which a fixed avatar looks most like the pictures.

    Each timestep descends on its own, by Adam on L1 and SSIM, for the same number of steps. Timesteps in which nothing
    was found, or in which a hand covers the face, get corrections from their neighbours.

    Args:
        avatar: The avatar, on the CPU. It is the same afterwards.
        sequences: The sequences.
        starts: The face parameters of each sequence to start from.
        settings: Settings of the descent.
        held_out_cameras: Ids of cameras that are not looked at.
        progress: Makes progress bars.
    """
    lengths, single = [len(face) for face in starts], all(len(one.tracking.cameras) == 1 for one in sequences)
    turns, shift = Rate(settings.rate), Rate(TRAINING.aligned_shift * settings.rate)
    rates = FaceTuning(True, turns, turns, turns, shift, keep_mean_pose=True, keep_turns=single, within_bounds=True)
    track = FaceTrack(concatenate(list(starts)), rates, lengths, avatar.face_model.expression_bounds)
    targets = [Targets(sequence, settings.resolution, len(sequences), cleaned=True) for sequence in sequences]
    timesteps = [one for index, own in enumerate(sequences) for one in _looked_at(index, own, held_out_cameras)]
    adam = Adam()
    with one_torch_thread(), frozen(avatar), progress("aligning frames", len(timesteps), 0) as advance:
        for first in range(0, len(timesteps), TRAINING.aligned_together):
            batch = timesteps[first : first + TRAINING.aligned_together]
            indices = [track.index_of(sequence, timestep) for sequence, timestep, _ in batch]
            views = [
                _View(place, targets[sequence], timestep, camera)
                for place, (sequence, timestep, cameras) in enumerate(batch)
                for camera in cameras
            ]
            _descend(avatar, track, adam, indices, views, settings.iterations)
            advance(len(batch))
    track.steady_pose()
    return _split(track.params().detach(), lengths)


def _descend(
    avatar: Avatar, track: FaceTrack, adam: Adam, indices: Items[int], views: Items[_View], iterations: int
) -> None:
    """Move the timesteps of a batch towards their pictures."""
    shown = [view.targets.target(view.timestep, view.camera, _WHITE, keep=False) for view in views]
    for iteration in range(iterations):
        posed = avatar.pose(concatenate([track.face(index) for index in indices])).gaussians.timesteps()
        pictures = rasterize_each(
            [(posed[view.place], view.targets.camera(view.camera)) for view in views],
            [target.background for target in shown],
        )
        losses = [
            photometric_loss(picture.image, target.picture, box=target.box, drawn=picture.alpha)
            for picture, target in zip(pictures, shown, strict=True)
        ]
        torch.autograd.backward(losses)
        groups = [group for index in indices for group in track.parameter_groups(index)]
        adam.step(groups, Progress(iteration, iterations))
        for index in indices:
            track.confine(index)


def _looked_at(
    index: int, sequence: Sequence, held_out_cameras: Items[str]
) -> Iterator[tuple[int, int, tuple[int, ...]]]:
    """The timesteps of a sequence to align: its index, the timestep, and the cameras that see the face."""
    kept = [camera_id not in held_out_cameras for camera_id in sequence.capture.camera_ids]
    usable = sequence.usable() & sequence.clear() & np.array(kept)
    for timestep in range(sequence.capture.timesteps):
        cameras = np.flatnonzero(usable[timestep]).tolist()
        if cameras:
            yield index, timestep, tuple(cameras)


def _split(faces: FaceParams, lengths: Items[int]) -> list[FaceParams]:
    ends = np.cumsum(lengths).tolist()
    return [faces[end - length : end] for end, length in zip(ends, lengths, strict=True)]
