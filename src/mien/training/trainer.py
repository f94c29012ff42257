"""The training loop, for every method."""

import math
import time
from collections.abc import Callable
from collections.abc import Sequence as Items
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien import _native
from mien.arrays import direct_gradients, own_derivative
from mien.avatar.avatar import Avatar, ParameterGroup, Posed, move_avatar
from mien.avatar.baking import measure_filmed
from mien.avatar.density import DensityControl, GradientDensity
from mien.avatar.files import load_avatar
from mien.avatar.methods import method_named, method_of
from mien.avatar.settings import FaceTuning, MethodConfig, Progress
from mien.avatar.store import GaussianStore
from mien.disk.locks import hold
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.params import FaceParams, concatenate
from mien.gaussians import Rendering
from mien.machine.devices import choose_device, gpu_memory_mb, like_on
from mien.machine.progress import Advance, progress_bar
from mien.machine.stops import stops_put_off
from mien.machine.threads import one_torch_thread
from mien.perceptual.features import load_training_features
from mien.render.validation import CannotDrawError
from mien.training.adam import Adam
from mien.training.apart import frames_apart, summed, threads_of_frames
from mien.training.batch import (
    TrainingData,
    coarse_steps,
    compare,
    compare_features,
    draw,
    face_groups,
    next_batch,
    seen,
    targets_ahead,
)
from mien.training.checkpoint import TrainingState, resume, write_checkpoint
from mien.training.colors import camera_colors, frame_gains
from mien.training.density_control.gradient import GradientStrategy
from mien.training.density_control.refill import RefillStrategy
from mien.training.density_control.strategy import DensityStrategy
from mien.training.footage.coverage import measure_coverage, representative_frames
from mien.training.footage.face_track import FaceTrack, turns_from_mean
from mien.training.footage.frames import (
    DENSITY,
    BatchFrame,
    Footage,
    FrameOrder,
    camera_extent,
    expression_rarity,
    random_at,
    training_frames,
)
from mien.training.footage.mesh_colors import vertex_colors
from mien.training.footage.sequence import Sequence, Targets
from mien.training.losses import train_psnr
from mien.training.run import BUSY_REMEDY, claim_run, is_finished, write_results
from mien.training.settings import TrainSettings, resolved
from mien.training.whole_head.head import WholeHead, prepare_whole_head
from mien.training.whole_head.outline_fit import fitted_faces

ALIGNED_TUNING = 0.2  # share of the learning rates of faces in a training on aligned faces. Measured: the log, 11-27
STEADY_EVERY = 25
"""Number of steps after which corrections of the head's pose lose what settings do not allow (`steady_pose`)."""
_REPRESENTATIVE_FRAMES = 12
"""Number of evenly spread frames, and of frames that show turned heads, in which hidden Gaussians are looked for."""

ProgressBar = Callable[[str, int, int], AbstractContextManager[Advance]]
"""(title, total, completed) -> a context manager whose value moves the bar on."""
Watch = Callable[[Avatar], None]
"""Is called with the avatar after each step."""


def train(
    sequences: Items[Sequence],
    face_model: FaceModel,
    method_config: MethodConfig,
    settings: TrainSettings,
    run_dir: Path,
    progress: ProgressBar = progress_bar,
    watch: Watch | None = None,
) -> Avatar:
    """Train an avatar on some sequences of one subject. The result is also in `run_dir`.

    `watch` is called after each step. It must not change the avatar.

    If `run_dir` holds a stopped run with the same settings, training continues where it stopped, and the result has the
    same bytes as without the stop. If that run is finished, its avatar is loaded.
    Ctrl-C and SIGTERM (`Terminated`) are raised once a checkpoint is written.
    """
    method_config.check()
    settings.check()
    check_trackings(sequences, face_model)
    frames = training_frames(sequences, settings)
    weights = expression_rarity(sequences, frames) if settings.frame_order == "rare" else None
    camera_colors(sequences, frames, settings, torch.zeros(()))  # raises before anything is written
    order, extent = FrameOrder(frames, settings.seed, weights), camera_extent(sequences, frames)
    if method_config.photometric.perceptual.weight > 0:
        load_training_features()  # Missing weights must not stop a run in its middle.
    if is_finished(run_dir):
        claim_run(run_dir, sequences, method_config, settings)
        return load_avatar(run_dir)
    with hold(run_dir, remedy=BUSY_REMEDY):
        claim_run(run_dir, sequences, method_config, settings)
        if is_finished(run_dir):  # another process finished it before this one got the lock
            return load_avatar(run_dir)
        like = like_on(choose_device(settings.device))
        gpu_memory_mb(like.device, restart=True)
        state = start(sequences, face_model, method_config, settings, like)
        head = state.head
        inside = None if head is None else head.hideable
        parts_of = face_model if method_config.photometric.needs_parts or inside is not None else None
        settings = resolved(settings, filled=head is not None and head.fills)
        cleaned = settings.edges == "cleaned"
        targets = tuple(
            Targets(sequence, settings.resolution, len(sequences), like, parts_of, inside, cleaned=cleaned)
            for sequence in sequences
        )
        coarse = coarse_steps(targets, settings)
        halved = tuple(one.halved() for one in targets) if coarse else ()
        faces = [sequence.tracking.face for sequence in sequences]
        footage = Footage(face_model, sequences, faces, frames)
        representative = representative_frames(footage, _REPRESENTATIVE_FRAMES, _REPRESENTATIVE_FRAMES)
        data = TrainingData(order, targets, extent, tuple(representative), halved, coarse)
        _train_to_the_end(state, data, settings, run_dir, progress, watch)
        known = None if head is None else head.coverage
        write_results(run_dir, state, known or measure_coverage(footage))
    return state.avatar


def _train_to_the_end(
    state: TrainingState,
    data: TrainingData,
    settings: TrainSettings,
    run_dir: Path,
    progress: ProgressBar,
    watch: Watch | None,
) -> None:
    """Continue from the newest checkpoint, if there is one, and take all steps that are left."""
    resume(run_dir / "checkpoints", state)
    with (
        one_torch_thread(),
        stops_put_off() as stop,
        targets_ahead(data.order, data.targets_at, settings) as ahead,
        threads_of_frames(state.avatar.face_model.template) as each,
    ):
        data = replace(data, ahead=ahead, each=each)
        pretrain(state, settings, progress, stop.follow)
        with progress("training", settings.steps, state.step) as advance:
            while state.step < settings.steps:
                before = state.step
                try:
                    status = step(state, data, settings)
                except CannotDrawError as error:
                    raise _diverged(run_dir, state, str(error)) from None
                advance(state.step - before, status)
                if before < data.coarse_steps <= state.step:
                    for halved in data.coarse:
                        halved.forget()
                if watch is not None:
                    watch(state.avatar)
                every = settings.checkpoint_every
                if state.step // every > before // every or stop.asked():
                    _check_finite(run_dir, state)
                    write_checkpoint(run_dir / "checkpoints", state)
                stop.follow()
        _check_finite(run_dir, state)


def pretrain(
    state: TrainingState, settings: TrainSettings, progress: ProgressBar, between: Callable[[], None] = lambda: None
) -> None:
    """Run the steps that a method takes before the first picture, if it has any and no step was taken yet.

    A run that stops here starts again, as nothing was trained. `between` is called after each step and may raise.
    """
    pretraining = state.avatar.extras.pretraining
    if state.step > 0 or pretraining is None:
        return
    with (
        torch.random.fork_rng(devices=[]),
        progress("pre-training on the face's motion", pretraining.count, 0) as advance,
    ):
        torch.manual_seed(settings.seed)
        for _ in pretraining.run(state.track.trained_face()):
            advance()
            between()


def _check_finite(run_dir: Path, state: TrainingState) -> None:
    for name, tensor in state.avatar.state_dict().items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise _diverged(run_dir, state, f"{name} is not finite")


def _diverged(run_dir: Path, state: TrainingState, what: str) -> UserError:
    return UserError(
        f"{run_dir}: training diverged by step {state.step} ({what}); lower the learning rates and weights that "
        "differ from the preset's, and train under another name (--run NAME)"
    )


def check_trackings(sequences: Items[Sequence], face_model: FaceModel) -> None:
    """Check that the sequences show one person, fitted with this face model."""
    for sequence in sequences:
        place = str(sequence.folder or sequence.name)
        if sequence.tracking.face_model_hash != face_model.content_hash:
            raise UserError(
                f"{place}: was tracked with another version of face model {sequence.tracking.face_model!r} "
                f"({sequence.tracking.face_model_hash}) than {face_model.name!r} now is ({face_model.content_hash}); "
                "run `mien track` again"
            )
        check_face_params(face_model, sequence.tracking.face, place, "track again")
        if not sequence.tracking.face.identity.equal(sequences[0].tracking.face.identity):
            raise UserError(
                f"{place}: was tracked apart from {sequences[0].name}, so that there are two identities; "
                "run `mien track` on their workspace"
            )


def start(
    sequences: Items[Sequence],
    face_model: FaceModel,
    method_config: MethodConfig,
    settings: TrainSettings,
    like: Tensor | None = None,
) -> TrainingState:
    """The state before the first step, with the float dtype and device of `like` (default: float32 on the CPU)."""
    faces, frames = [sequence.tracking.face for sequence in sequences], training_frames(sequences, settings)
    starts = [sum(map(len, faces[:index])) for index in range(len(faces))]
    used = [starts[frame.sequence] + frame.timestep for frame in frames]
    # Nothing of a held-out frame may reach the avatar, not even how its face was tracked.
    shown = sorted(set(used))
    avatar = _first_avatar(method_config, face_model, concatenate(faces)[shown], settings)
    footage = Footage(face_model, sequences, faces, frames)
    fitted = fitted_faces(footage, settings, bound=avatar.extras.surface is not None)
    if fitted is not None:
        faces, footage = fitted, replace(footage, faces=fitted)
        avatar = _first_avatar(method_config, face_model, concatenate(faces)[shown], settings)
    face = concatenate(faces)
    eyes = torch.stack([sequences[frame.sequence].tracking.cameras[frame.camera].position for frame in frames])
    avatar.filmed = measure_filmed(face[used], eyes)
    surface = avatar.extras.surface
    if surface is not None and surface.wants_first_colors:
        surface.set_first_colors(vertex_colors(footage))
    like = torch.zeros(()) if like is None else like
    gains, colors = frame_gains(sequences, frames, settings, like), camera_colors(sequences, frames, settings, like)
    make_head = prepare_whole_head(avatar, footage, settings)
    away = turns_from_mean(face, shown)
    move_avatar(avatar, like)
    face = face.to(like)
    head, density = None if make_head is None else make_head(like), avatar.density()
    strategy = density_strategy(density if head is None else head.density(density), avatar.store)
    lengths = [len(sequence.tracking.face) for sequence in sequences]
    tuning = tuning_for(method_config.face_tuning, sequences)
    track = FaceTrack(face, tuning, lengths, face_model.expression_bounds, away, shown)
    return TrainingState(avatar, Adam(), strategy, track, {}, head, gains, colors)


def _first_avatar(config: MethodConfig, face_model: FaceModel, face: FaceParams, settings: TrainSettings) -> Avatar:
    """The avatar before the first step. The same settings give the same bytes."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return method_named(method_of(config)).avatar(config, face_model, face)


def density_strategy(density: DensityControl, store: GaussianStore) -> DensityStrategy | None:
    """The strategy that a method's description asks for."""
    if density is None:
        return None
    device = store[store.names()[0]].device
    if isinstance(density, GradientDensity):
        return GradientStrategy(density, len(store), device)
    return RefillStrategy(density, len(store), device)


def tuning_for(tuning: FaceTuning, sequences: Items[Sequence]) -> FaceTuning:
    """The settings for these sequences.

    Several cameras see how far a head turns, so corrections may follow turns. Aligned faces are nearly right, so
    corrections are slower.
    """
    if any(len(sequence.tracking.cameras) > 1 for sequence in sequences):
        tuning = replace(tuning, keep_turns=False)
    if all(sequence.tracking.aligned for sequence in sequences):
        tuning = tuning.slowed(ALIGNED_TUNING)
    return tuning


def step(state: TrainingState, data: TrainingData, settings: TrainSettings) -> str:
    """Run one training step: pose, render, compare, update, add and prune. Returns a text for the progress bar.

    The avatar says how many frames the step uses. The losses of pictures are means over them, and the step counts as so
    many.
    """
    began = time.perf_counter()
    avatar, head = state.avatar, state.head
    batch = next_batch(state, data, settings)
    progress = Progress(state.step, settings.steps, data.order.at(state.step)[1], data.extent, len(batch))
    if head is not None:
        head.before_step(batch, data.meanwhile)
    groups = _groups(state, batch)
    parts, losses = [], {}
    if avatar.extras.apart and len(batch) > 1:
        parts = frames_apart(state, batch, progress, groups, data.each)
        posed = [part.posed for part in parts if part.posed is not None]
        renderings = [part.rendering for part in parts if part.rendering is not None]
        shown = [part.shown for part in parts if part.shown is not None]
    else:
        whole, posed, renderings = draw(state, batch, progress)
        shown = seen(state, batch, renderings)
        losses = compare(state, batch, shown) | avatar.regularizers(whole, renderings[0], progress)
        losses |= compare_features(state, batch, shown)
        if head is not None:
            losses |= head.losses(progress)
        with direct_gradients():
            torch.autograd.backward(list(losses.values()), [own_derivative(loss) for loss in losses.values()])
    if head is not None:
        head.after_backward(progress, renderings)

    changed = _update(state, settings, batch, progress, groups, posed, renderings)
    if changed:
        _native.release_memory()  # Blocks of the sizes that tensors had are of no use.
    state.step = progress.done
    if head is not None:
        _after_update(state, head, data, progress, changed=changed)
    elapsed = time.perf_counter() - began
    state.seconds += elapsed
    if not progress.reaches(settings.record_every) and state.step != settings.steps:
        return ""
    losses = losses or summed(parts, len(batch))
    return _record(state, losses, train_psnr(shown[0], batch[0].target), elapsed * 1000 / len(batch))


def _groups(state: TrainingState, batch: Items[BatchFrame]) -> list[ParameterGroup]:
    groups = [*state.avatar.parameter_groups(), *face_groups(state, batch)]
    return groups + [group for own in state.colors for group in own.learned.parameter_groups()]


def _update(
    state: TrainingState,
    settings: TrainSettings,
    batch: Items[BatchFrame],
    progress: Progress,
    groups: Items[ParameterGroup],
    posed: Items[Posed],
    renderings: Items[Rendering],
) -> bool:
    """Update all trained tensors, then add and prune Gaussians. Returns whether the Gaussians may have changed."""
    if state.density is not None:
        for own, rendering in zip(posed, renderings, strict=True):
            state.density.observe(own, rendering)
    state.adam.step(groups, progress, len(batch) if state.avatar.extras.apart else 1)
    for one in batch:
        state.track.confine(one.index)
    if progress.reaches(STEADY_EVERY):
        state.track.steady_pose()
    if state.density is None:
        return False
    random = partial(random_at, settings.seed, DENSITY, progress.step)
    return state.density.adapt(state.avatar.store, posed[0], progress, random)


def _after_update(
    state: TrainingState, head: WholeHead, data: TrainingData, progress: Progress, *, changed: bool
) -> None:
    """Keep a head to its surface. At times and at the end, remove Gaussians that pictures do not show."""
    head.after_update(progress)
    head.move_hair(progress)
    due = changed or head.finds_rigid(progress) or progress.done >= progress.steps
    if state.density is not None and head.fills and due and data.representative:
        track = state.track

        def redundant() -> Bool[Tensor, " n"]:
            views = [
                (track.face(track.index_of(*frame[:2])).detach(), data.camera(frame)) for frame in data.representative
            ]
            return head.redundant(views, progress)

        state.density.thin(state.avatar.store, redundant)


def _record(state: TrainingState, losses: dict[str, Float[Tensor, ""]], psnr: float, step_ms: float) -> str:
    # One answer of a GPU instead of one for each loss.
    values = torch.stack([value.detach() for value in losses.values()]).tolist()
    entry = dict(zip(losses, values, strict=True))
    infinite = [name for name, value in entry.items() if not math.isfinite(value)]
    if infinite:
        raise CannotDrawError(f"the loss {infinite[0]} is {entry[infinite[0]]}")
    rare = [] if state.head is None else [*state.head.rare_losses]
    rare += ["perceptual"] if state.avatar.config.photometric.perceptual.weight > 0 else []
    for name in rare:
        entry.setdefault(name, 0.0)
    entry |= {"step": state.step, "loss": sum(entry.values()), "psnr": psnr}
    entry |= {"gaussians": len(state.avatar.store), "step_ms": step_ms}
    for name, value in entry.items():
        state.curves.setdefault(name, []).append(value)
    return f"loss {entry['loss']:.4f}, PSNR {entry['psnr']:.1f} dB, {entry['gaussians']} Gaussians"
