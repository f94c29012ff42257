"""All frames aligned again, to a quick avatar of the person: analysis by synthesis.

Tracking fits a face model that has one texture. A trained avatar knows the person better: hair, ears, teeth, glasses.
So a quick avatar, the template, is trained on the training frames. Then the face parameters of each frame move until
the template, which stays as it is, looks like the picture. This is tracking: a held-out frame is looked at for its own
face parameters, as in every fit to pixels, and reaches no avatar and no face of another frame.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.avatar import Avatar, ParameterGroup, frozen, move_avatar
from mien.avatar.methods import DEFAULT_METHOD
from mien.avatar.settings import FaceTuning
from mien.avatar.store import Moments
from mien.camera import Camera
from mien.disk.config import overlay
from mien.disk.files import read_tensors, write_tensors
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams, concatenate
from mien.face.torso import has_torso, torso_pose, with_torso
from mien.machine.devices import choose_device, like_on
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import progress_bar
from mien.machine.threads import one_torch_thread
from mien.render.rasterize import rasterize_each
from mien.training.colors import lit, read_gains
from mien.training.footage.face_track import FaceTrack, corrected_poses, pose_corrections, turns_from_mean
from mien.training.footage.frames import Frame, evenly_spread, training_frames
from mien.training.footage.sequence import Sequence, Target, Targets
from mien.training.losses import photometric_loss
from mien.training.run import read_face_track
from mien.training.settings import PRESETS, AlignmentSettings, TrainSettings
from mien.training.trainer import ProgressBar, train

ALIGNED_BETWEEN = 16  # number of timesteps from one time that results are written to the next
_ALIGNED_JUDGED = 32  # number of training timesteps that say how large gradients are
_ALIGNED_MOMENTUM = 0.7  # share of the last steps' direction in the next one. Measured: the log, 11-27
_ALIGNED_EXPRESSION = 10.0
"""Rate of expression coefficients, as a share of that of the head's rotation. Measured: the log, 11-27."""
_ALIGNED_TURN = 7e-4  # how far a step turns a head whose gradient has the usual size, in radians
_ALIGNED_JOINTS = 3.0  # rate of joint angles, as a share of that of the head's rotation. Measured: the log, 11-27
_ALIGNED_SHIFT = 0.3
"""Rate of the head's position in metres, as a share of that of its rotation in radians: the ratio with which training
corrects the tracking."""

_WHITE, _ON_CPU = np.full(3, 255, np.uint8), torch.zeros(())
_EPSILON = 1e-12
"""Least size of gradients, so that those of zero move nothing."""
_TEMPLATE_GROW_GRADIENT = 2e-4
"""`grow_gradient` of the quick avatar. The alignment was measured with it (log, 11-27)."""
_KEPT = "aligned.safetensors"
"""File with the parameters of timesteps that are aligned."""
_Timestep = tuple[int, int, tuple[int, ...]]
"""A timestep to align: the index of its sequence, the timestep, and the cameras that see the face."""


@dataclass(frozen=True, eq=False)
class _View:
    """One picture of a timestep."""

    camera: Camera
    target: Target
    gain: Float[Tensor, " 3"] | None
    """The light of its timestep. None if it is steady."""


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
    `training` is of the run that the alignment is for: what is held out, seed and device. The template is trained in
    `folder`, where aligned frames are kept, too. What was stopped continues there.
    """
    config = overlay(
        PRESETS["draft"].config(DEFAULT_METHOD),
        {"density": {"max_gaussians": settings.template_gaussians, "grow_gradient": _TEMPLATE_GROW_GRADIENT}},
        "template",
        DEFAULT_METHOD,
    )
    # Only filmed views are drawn, so sides need no fill, and the colours of a fixed background disturb nothing.
    how = replace(
        training,
        steps=settings.template_steps,
        resolution=settings.resolution,
        coarse=0.0,
        background="white",
        edges="cleaned",
        unseen="trained",
        mesh="tracked",
    )

    def titled(title: str, total: int, completed: int):  # noqa: ANN202
        return progress(f"template: {title}", total, completed)

    template, like = train(sequences, face_model, config, how, folder, titled), like_on(choose_device(training.device))
    move_avatar(template, like)
    lengths = [len(sequence.tracking.face) for sequence in sequences]
    starts = _split(read_face_track(folder, face_model), lengths)
    known = training_frames(sequences, how)
    gains = read_gains(folder, lengths)
    aligned = align_faces(
        template, sequences, starts, known, settings, training.held_out_cameras, folder, progress, gains, like
    )
    tracked = [sequence.tracking.face for sequence in sequences]
    steady = [steadier(*each) for each in zip(tracked, aligned, _trained(known, lengths), strict=True)]
    if not has_torso(face_model):
        return steady
    # A frame alone does not tell a torso, which is smooth in the world as it was tracked.
    pairs = zip(steady, tracked, strict=True)
    return [with_torso(face_model, face, torso_pose(face_model, before)) for face, before in pairs]


def steadier(tracked: FaceParams, aligned: FaceParams, trained: Bool[Tensor, " t"]) -> FaceParams:
    """The aligned face parameters of a sequence, with corrections of the head's pose that are averaged over time.

    Each frame is aligned on its own, which makes heads tremble. A tracking's errors change slowly, so its corrections
    are averaged over three timesteps. Expressions stay, since averaging them costs detail.
    Timesteps that training uses (`trained`) take nothing from others, so that no held-out frame moves them.
    """
    own, places = pose_corrections(tracked, aligned), torch.arange(len(aligned))

    def beside(step: int) -> Float[Tensor, "t 6"]:
        others = (places + step).clamp(0, len(places) - 1)
        return own[torch.where(trained[others] | ~trained, others, places)]

    poses = corrected_poses(tracked, (beside(-1) + 2 * own + beside(1)) / 4)
    return replace(aligned, head_rotation=poses.head_rotation, head_translation=poses.head_translation)


def align_faces(
    avatar: Avatar,
    sequences: Items[Sequence],
    starts: Items[FaceParams],
    known: Items[Frame],
    settings: AlignmentSettings,
    held_out_cameras: Items[str] = (),
    folder: Path | None = None,
    progress: ProgressBar = progress_bar,
    gains: Items[Float[Tensor, "t 3"]] = (),
    like: Float[Tensor, ""] = _ON_CPU,
) -> list[FaceParams]:
    """Return the face parameters of each sequence with which a fixed avatar looks most like the pictures.

    Each timestep descends on its own on L1 and SSIM, for the same number of steps (`descend`). Timesteps in which
    nothing was found, or in which a hand covers the face, get corrections from their neighbours.
    Some frames of `known`, on which the avatar was trained, say how large gradients are, and they alone say what
    corrections of head poses share. With a folder, a stopped call continues there. The avatar is on the device of
    `like`, where frames are fitted one after the other; on the CPU, each has a thread.
    """
    lengths, single = [len(face) for face in starts], all(len(one.tracking.cameras) == 1 for one in sequences)
    tuning, bounds = _tuning(single), avatar.face_model.expression_bounds
    used = torch.cat(_trained(known, lengths)).nonzero()[:, 0].tolist()
    face = concatenate(list(starts))
    track = FaceTrack(face.to(like), tuning, lengths, bounds, turns_from_mean(face, used), used)
    targets = [Targets(sequence, settings.resolution, len(sequences), like, cleaned=True) for sequence in sequences]
    gains, each = [own.to(like) for own in gains], stream_in_threads if like.is_cpu else map
    timesteps = [one for index, own in enumerate(sequences) for one in _looked_at(index, own, held_out_cameras)]
    trained = {frame[:2] for frame in known}
    judged = evenly_spread([one for one in timesteps if one[:2] in trained] or timesteps, _ALIGNED_JUDGED)
    with one_torch_thread(), frozen(avatar):
        sizes = _sizes((_Target.of(one, track, targets, gains) for one in judged), avatar, track, each)
        indices = [track.index_of(*timestep[:2]) for timestep in timesteps]
        done = _take_up(folder, track, indices)

        @torch.enable_grad()
        def descended(target: _Target) -> None:
            for _ in range(settings.iterations):
                target.find_gradients(avatar, track)
                descend(track.parameter_groups(target.index), sizes)
                track.confine(target.index)

        with progress("aligning frames", len(timesteps), done) as advance:
            waiting = (_Target.of(one, track, targets, gains) for one in timesteps[done:])
            for _ in each(descended, waiting):
                done += 1
                if done % ALIGNED_BETWEEN == 0 or done == len(timesteps):
                    _keep(folder, track, indices[:done])
                advance(1)
    track.steady_pose()
    return _split(track.params().detach().to(_ON_CPU), lengths)


def _keep(folder: Path | None, track: FaceTrack, indices: list[int]) -> None:
    if folder is not None:
        each = [_values(track, index) for index in indices]
        write_tensors(folder / _KEPT, {name: torch.stack([values[name] for values in each]) for name in each[0]})


@torch.no_grad()
def _take_up(folder: Path | None, track: FaceTrack, indices: list[int]) -> int:
    """Take what `_keep` wrote. Return how many timesteps that is, which are the first of `indices`."""
    if folder is None or not (folder / _KEPT).exists():
        return 0
    try:
        kept = read_tensors(folder / _KEPT)
    except UserError:  # damaged
        return 0
    shapes = {name: tensor.shape for name, tensor in _values(track, indices[0]).items()}
    counts = {len(tensor) for tensor in kept.values() if tensor.ndim}
    if {name: tensor.shape[1:] for name, tensor in kept.items()} != shapes or len(counts) != 1:
        return 0
    done = counts.pop()
    for place, index in enumerate(indices[:done]):
        for name, tensor in _values(track, index).items():
            tensor.copy_(kept[name][place])
        for group in track.parameter_groups(index):
            for name in group.tensors:
                _moments(group, name).step += 1  # tells the track that the timestep moved
    return min(done, len(indices))


def _values(track: FaceTrack, index: int) -> dict[str, Tensor]:
    groups = track.parameter_groups(index)
    return {f"{group.name}.{name}": tensor for group in groups for name, tensor in group.tensors.items()}


def _tuning(single: bool) -> FaceTuning:
    rates = (_ALIGNED_EXPRESSION, _ALIGNED_JOINTS, 1.0, _ALIGNED_SHIFT)
    own = [share * _ALIGNED_TURN for share in rates]
    return FaceTuning(True, *own, keep_mean_pose=True, keep_turns=single, within_bounds=True)


@dataclass(frozen=True, eq=False)
class _Target:
    """What one timestep is to look like."""

    index: int
    """Index of the timestep in the track."""
    views: list[_View]

    @staticmethod
    def of(timestep: _Timestep, track: FaceTrack, targets: Items[Targets], gains: Items[Tensor]) -> "_Target":
        """The target of a timestep. Only one thread may make targets."""
        sequence, number, cameras = timestep
        own, gain = targets[sequence], gains[sequence][number] if gains else None
        pictures = {camera: own.target(number, camera, _WHITE, keep=False) for camera in cameras}
        views = [_View(own.camera(camera), target, gain) for camera, target in pictures.items()]
        return _Target(track.index_of(sequence, number), views)

    def find_gradients(self, avatar: Avatar, track: FaceTrack) -> None:
        """Draw all views, and leave the gradient of what differs from their pictures at the parameters."""
        posed = avatar.pose(track.face(self.index)).gaussians.timestep(0)
        pictures = rasterize_each(
            [(posed, view.camera) for view in self.views], [view.target.background for view in self.views]
        )
        losses = []
        for picture, view in zip(pictures, self.views, strict=True):
            target = view.target
            seen = picture if view.gain is None else lit(picture, target.background, view.gain)
            losses.append(photometric_loss(seen.image, target.picture, box=target.box, drawn=seen.alpha))
        torch.autograd.backward(losses)


@torch.no_grad()
def descend(groups: Items[ParameterGroup], sizes: Mapping[str, Float[Tensor, ""]]) -> None:
    """A step along the gradient with momentum, in units of its usual size. The gradients are cleared.

    `sizes` are the root mean squares of each group's gradients over coefficients and over some timesteps. Adam divides
    the gradient of a timestep by its own size, so that its first steps move every coefficient by the whole rate,
    whether it matters or not. Here, what matters more moves further, and a timestep that fits stays.
    """
    kept = _ALIGNED_MOMENTUM
    for group in groups:
        for (name, tensor), gradient in zip(group.tensors.items(), _taken(group), strict=True):
            state = _moments(group, name)
            state.step += 1
            state.first.lerp_(gradient, 1 - kept)
            unbiased = state.first / (1 - kept ** state.step.item())
            tensor -= group.rate.start / sizes[group.name].clamp_min(_EPSILON) * unbiased


def _sizes(
    targets: Iterable[_Target], avatar: Avatar, track: FaceTrack, each: Callable[..., Iterator[Any]]
) -> dict[str, Float[Tensor, ""]]:
    """The sizes for `descend` at the present parameters of some timesteps."""

    @torch.enable_grad()
    def gradients(target: _Target) -> dict[str, list[Tensor]]:
        target.find_gradients(avatar, track)
        return {group.name: _taken(group) for group in track.parameter_groups(target.index)}

    found: dict[str, list[Tensor]] = {}
    for own in each(gradients, targets):
        for name, gradient in own.items():
            found.setdefault(name, []).extend(gradient)
    return {name: torch.stack(own).double().square().mean().sqrt() for name, own in found.items()}


def _taken(group: ParameterGroup) -> list[Tensor]:
    """The gradients of a group, which it has no more afterwards."""
    gradients = [torch.zeros_like(one) if one.grad is None else one.grad for one in group.tensors.values()]
    for tensor in group.tensors.values():
        tensor.grad = None
    return gradients


def _moments(group: ParameterGroup, name: str) -> Moments:
    assert group.moments is not None
    state = group.moments[name]
    assert isinstance(state, Moments)
    return state


def _looked_at(index: int, sequence: Sequence, held_out_cameras: Items[str]) -> Iterator[_Timestep]:
    kept = [camera_id not in held_out_cameras for camera_id in sequence.capture.camera_ids]
    usable = sequence.usable() & sequence.clear() & np.array(kept)
    for timestep in range(sequence.capture.timesteps):
        cameras = np.flatnonzero(usable[timestep]).tolist()
        if cameras:
            yield index, timestep, tuple(cameras)


def _trained(known: Items[Frame], lengths: list[int]) -> list[Bool[Tensor, " t"]]:
    """Which timesteps of each sequence have a frame that the avatar was trained on."""
    found = [torch.zeros(length, dtype=torch.bool) for length in lengths]
    for frame in known:
        found[frame.sequence][frame.timestep] = True
    return found


def _split(faces: FaceParams, lengths: Items[int]) -> list[FaceParams]:
    ends = np.cumsum(lengths).tolist()
    return [faces[end - length : end] for end, length in zip(ends, lengths, strict=True)]
