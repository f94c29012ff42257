"""Several frames in one optimiser step, and pictures of half the size at the start of a run.

A run that is stopped at any moment and started again ends with the same bytes as an uninterrupted one."""

import signal
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import train_toy
from forked import ForkServer
from instruction_sets import by_threads
from known import known
from mien.adam import BETA1, Moments
from mien.arrays import direct_gradients
from mien.avatar import Avatar
from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
from mien.avatar.ops.triangle_penalties import triangle_penalties
from mien.avatar.settings import MethodConfig, PerceptualLoss, Photometric, Progress
from mien.disk.files import read_tensors, write_tensors
from mien.errors import UserError
from mien.face import load_face_model
from mien.lab.benchmarking.train_step import SETTINGS as BENCHMARK_SETTINGS
from mien.lab.benchmarking.train_step import training_case
from mien.machine.stops import Terminated
from mien.render import rasterize
from mien.render.rasterize import rasterize_each
from mien.training import TrainSettings, train, trainer
from mien.training.apart import threads_of_frames
from mien.training.batch import TrainingData, coarse_steps, next_batch
from mien.training.checkpoint import TrainingState, checkpoint_files
from mien.training.footage.sequence import Targets
from mien.training.run import read_curves, read_training_summary
from mien.training.trainer import start, step
from plain_settings import plain_gaussian_avatars, plain_mono_gaussian_avatar, plain_run
from refusals import refuses
from test_methods import new_avatar
from toy_scene import random, toy_camera, toy_data, toy_face, toy_sequence

SMALL = plain_mono_gaussian_avatar(
    points=60, max_points=120, epochs=6, attribute_width=32, deformation_width=16, change_width=16, frames_per_step=4
)
SETTINGS = plain_run(steps=30, split="none", background="random", checkpoint_every=7, record_every=5)


def new_state(
    config: MethodConfig = SMALL, settings: TrainSettings = SETTINGS, timesteps: int = 7
) -> tuple[TrainingState, TrainingData]:
    face_model, sequence = toy_sequence(timesteps, 32)
    state = start([sequence], face_model, config, settings)
    return state, toy_data(sequence, settings)


def pull_at(state: TrainingState, data: TrainingData, frame: int, name: str = "means") -> torch.Tensor:
    """Return the gradient of the points in the first step, which begins at a frame: ten times the first moments."""
    state.step = frame
    step(state, data, SETTINGS)
    averaged = state.avatar.extras.frames_per_step(0.0) if state.avatar.extras.apart else 1
    return means_moments(state, name).first / (1 - BETA1**averaged)


BOUND = plain_gaussian_avatars(scale_threshold=0.01)
UNCHANGING = replace(BOUND, density=replace(BOUND.density, start=0.9, stop=1.0))
"""As published, with the same Gaussians in the first steps, whose scales have a penalty."""


def means_moments(state: TrainingState, name: str = "means") -> Moments:
    moments = state.avatar.store.moments[name]
    assert isinstance(moments, Moments)
    return moments


@pytest.mark.unchecked
@pytest.mark.parametrize(("config", "name"), [(SMALL, "means"), (UNCHANGING, "log_scales")], ids=["together", "apart"])
def test_a_step_follows_the_mean_of_its_frames(config: Any, name: str) -> None:
    both = pull_at(*new_state(replace(config, frames_per_step=2)), 2, name)
    own = [pull_at(*new_state(replace(config, frames_per_step=1)), frame, name) for frame in (2, 3)]
    assert (own[0] - own[1]).abs().max() > 0.1 * own[0].abs().max()
    torch.testing.assert_close(both, (own[0] + own[1]) / 2, rtol=1e-4, atol=1e-4 * float(both.abs().max()))


def test_losses_of_a_picture_are_means_and_steps_pass_every_multiple_once() -> None:
    assert [now for now in range(0, 30, 4) if Progress(now, 100, frames=4).reaches(10)] == [8, 16, 28]
    assert not Progress(10, 100).reaches(10)
    progress = Progress(8, 100, frames=4)
    assert [count for count in range(20) if progress.completes([count])] == [9, 10, 11, 12]
    weights = Photometric(0.7, 0.3, 0.2, 0.5, PerceptualLoss(0.4))
    assert weights.scaled(1.0) is weights
    half = weights.scaled(0.5)
    # Parts count relative to the whole picture, whose weight is halved.
    assert half == Photometric(0.35, 0.15, 0.1, 0.5, PerceptualLoss(0.2))


@pytest.mark.unchecked
def test_steps_have_one_frame_late_in_a_run_and_rates_follow_their_number() -> None:
    config = replace(BOUND, frames_per_step=2, one_frame_from=0.5)
    state, data = new_state(config)
    done, rates = [], []
    while state.step < SETTINGS.steps:
        before = state.step
        step(state, data, SETTINGS)
        done.append(state.step)
        progress = Progress(before, SETTINGS.steps, frames=state.step - before)
        rates.append(
            next(group.rate_at(progress) for group in state.avatar.parameter_groups() if group.name == "quats")
        )
    # The step that began with 14 of 30 done is the last of two frames.
    assert done == [*range(2, 17, 2), *range(17, 31)]
    assert rates == pytest.approx([rates[-1] * 2**0.5] * 8 + [rates[-1]] * 14)
    assert [GaussianAvatarsConfig().frames_at(fraction) for fraction in (0.0, 0.599, 0.6, 1.0)] == [2, 2, 1, 1]


@pytest.mark.unchecked
def test_frames_come_in_the_order_of_a_run_with_one_frame_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    state, data = new_state()
    assert state.density is not None
    rounds, seen, adapt = [], [], state.density.adapt
    monkeypatch.setattr(state.density, "adapt", lambda *given: rounds.append(adapt(*given)) or rounds[-1])
    while state.step < SETTINGS.steps:
        batch = next_batch(state, data, SETTINGS)
        assert [one.number for one in batch] == list(range(state.step, state.step + len(batch)))
        seen += [one.frame for one in batch]
        step(state, data, SETTINGS)
    assert seen == [data.order.at(number)[0] for number in range(SETTINGS.steps)]
    # Seven steps of four frames, and one of the two that are left.
    assert means_moments(state).step == 8
    # Six numbers of steps at which the curves have an entry, of which the steps reach three alone.
    assert state.curves["step"] == [8, 12, 16, 20, 28, 30]
    # No round of density control is left out: those after 5, 10, .., 25 frames.
    assert rounds == [False, True, True, True, True, False, True, False]
    assert len(state.avatar.store) == 120


def test_a_timestep_that_comes_twice_is_updated_once() -> None:
    settings, tuning = replace(SETTINGS, steps=10), replace(SMALL.face_tuning, begin=0.0)
    state, data = new_state(replace(SMALL, face_tuning=tuning), settings, timesteps=3)
    step(state, data, settings)
    assert state.track.state()["expression.step"].tolist() == [1, 1, 1]


def test_many_points_mean_fewer_frames() -> None:
    """Other methods use one frame."""
    state, _ = new_state(replace(SMALL, frames_per_step=8, points_per_step=200))
    store, found = state.avatar.store, []
    for count in (20, 25, 26, 60, 100, 101, 200, 500):
        store.select(torch.arange(count) % len(store))
        found.append(state.avatar.extras.frames_per_step(0.0))
    assert found == [8, 8, 7, 3, 2, 1, 1, 1]
    refuses("frames-per-step 0", replace(SMALL, frames_per_step=0).check)
    assert [new_avatar(method).extras.frames_per_step(0.0) for method in ("gaussian_avatars", "headgas")] == [1, 1]


FILLED = replace(SETTINGS, unseen="filled", mesh="fitted")


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("config", "settings"), [(SMALL, SETTINGS), (GaussianAvatarsConfig(), FILLED)], ids=["together", "apart"]
)
def test_the_number_of_threads_changes_no_bit(config: Any, settings: TrainSettings) -> None:
    """Pictures of a step are drawn side by side, or one by one if there are more threads than frames."""

    def trained() -> dict[str, torch.Tensor]:
        state, data = new_state(config, settings)
        with threads_of_frames(torch.zeros(0)) as each:
            for _ in range(3):
                step(state, replace(data, each=each), settings)
        return state.avatar.state_dict()

    first, *others = by_threads(trained, (1, 2, 3, 6))
    assert all(torch.equal(tensor, other[name]) for other in others for name, tensor in first.items())


def test_views_with_their_own_backgrounds_and_sizes_are_drawn_as_alone() -> None:
    avatar, cameras = new_avatar("mono_gaussian_avatar"), [toy_camera(24), toy_camera(40)]
    backgrounds, means = [torch.ones(3), torch.tensor([0.1, 0.5, 0.9])], avatar.store["means"]

    def drawn(together: bool) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        own = avatar.pose(toy_face(2), Progress(0, 10)).gaussians.timesteps()
        if together:
            pictures = rasterize_each(list(zip(own, cameras, strict=True)), backgrounds)
        else:
            pictures = [rasterize(*view) for view in zip(own, cameras, backgrounds, strict=True)]
        images = [picture.image for picture in pictures]
        loss = torch.stack([image.square().sum() for image in images]).sum()
        return images, list(torch.autograd.grad(loss, [means, *(picture.means2d_offset for picture in pictures)]))

    (images, pulls), (alone, pulls_alone) = drawn(True), drawn(False)
    assert [tuple(image.shape) for image in images] == [(24, 24, 3), (40, 40, 3)]
    assert all(torch.equal(a, b) for a, b in zip(images, alone, strict=True))
    torch.testing.assert_close(pulls, pulls_alone)


COARSE = replace(train_toy.SETTINGS, steps=10, coarse=0.5, record_every=1)


@pytest.fixture
def _halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The toy's pictures are large enough to be halved."""
    monkeypatch.setattr("mien.training.batch.LEAST_HALVED", 32)


def sizes_of(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The sizes of targets and renderings of a run's steps."""
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    seen, compare = [], trainer.compare

    def looked(state: TrainingState, batch: Any, shown: Any) -> Any:
        seen.append((batch[0].camera.width, batch[0].target.picture.shape[0], shown[0].image.shape[0]))
        return compare(state, batch, shown)

    with monkeypatch.context() as patched:
        patched.setattr(trainer, "compare", looked)
        train([sequence], face_model, train_toy.CONFIG, COARSE, run_dir)
    return seen


@pytest.mark.unchecked
@pytest.mark.usefixtures("_halved")
def test_the_first_half_of_a_run_sees_pictures_of_half_the_size(tmp_path: Path, monkeypatch) -> None:
    """They are forgotten after their last step. Smaller ones keep their size."""
    forgotten, forget = [], Targets.forget
    monkeypatch.setattr(Targets, "forget", lambda self: forgotten.append(self.width) or forget(self))
    assert sizes_of(tmp_path / "large", monkeypatch) == [(16, 16, 16)] * 5 + [(32, 32, 32)] * 5
    assert forgotten == [16]
    monkeypatch.setattr("mien.training.batch.LEAST_HALVED", 384)
    assert sizes_of(tmp_path / "small", monkeypatch) == [(32, 32, 32)] * 10


@pytest.mark.usefixtures("_halved")
def test_halved_targets_show_the_same() -> None:
    targets = Targets(toy_sequence(timesteps=3, size=33)[1], 0)
    halved = targets.halved()
    assert (halved.width, halved.height) == (17, 17)
    assert halved.camera(0).K[0, 0] == pytest.approx(targets.camera(0).K[0, 0] * 17 / 33)
    white = np.full(3, 255, np.uint8)
    large, low = (one.target(0, 0, white, keep=False).picture.float().mean() for one in (targets, halved))
    assert float(low) == pytest.approx(float(large), abs=1)
    assert [coarse_steps([targets], replace(COARSE, coarse=share)) for share in (0.0, 0.5, 1.0)] == [0, 5, 10]


STEPS = train_toy.SETTINGS.steps
RESULTS = ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("undisturbed")
    train_toy.main(run_dir, STEPS)
    return run_dir


def train_until_step(run_dir: Path, last: int, stop: Callable[[], object]) -> None:
    """Train in this process, and call `stop` after a step of this process."""
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    steps = iter(range(1, STEPS + 1))

    def watch(_: Avatar) -> None:
        if next(steps) == last:
            stop()

    train([sequence], face_model, train_toy.CONFIG, train_toy.SETTINGS, run_dir, watch=watch)


interrupt = partial(signal.raise_signal, signal.SIGINT)


def assert_same_results(run_dir: Path, undisturbed: Path) -> None:
    for name in RESULTS:
        assert (run_dir / name).read_bytes() == (undisturbed / name).read_bytes(), f"{name} differs"
    ours, theirs = read_curves(run_dir), read_curves(undisturbed)
    for name in set(theirs) - {"step_ms"}:
        assert ours[name].tolist() == theirs[name].tolist(), f"curve {name} differs"


@pytest.mark.unchecked
def test_killed_runs_end_with_the_same_bytes(fork_server: ForkServer, tmp_path: Path, undisturbed: Path) -> None:
    """Stopped before the first checkpoint, during density control, and after resuming, with a damaged checkpoint."""
    for kill_at, checkpoints in ((2, []), (13, [8, 12]), (22, [16, 20])):
        process = fork_server.call("train_toy:main", str(tmp_path), STEPS, kill_at)
        assert process.wait() == -signal.SIGKILL, process.stderr
        assert steps_of_checkpoints(tmp_path) == checkpoints
    (tmp_path / "checkpoints" / ".step_0000024.safetensors.x.safetensors").write_bytes(b"half a checkpoint")
    newest = checkpoint_files(tmp_path / "checkpoints")[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    train_toy.main(tmp_path, STEPS)
    assert_same_results(tmp_path, undisturbed)
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2


def steps_of_checkpoints(run_dir: Path) -> list[int]:
    return [int(path.stem.removeprefix("step_")) for path in checkpoint_files(run_dir / "checkpoints")]


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated), (signal.SIGHUP, Terminated)]
)
@pytest.mark.unchecked
def test_a_stop_leaves_a_checkpoint_of_its_step(number, kind, tmp_path, undisturbed) -> None:
    """Also before the first record, when its curves are empty."""
    for last, stopped in ((1, 1), (6, 7)):
        pytest.raises(kind, train_until_step, tmp_path, last, partial(signal.raise_signal, number))
        assert steps_of_checkpoints(tmp_path)[-1] == stopped
    train_toy.main(tmp_path, STEPS)
    assert_same_results(tmp_path, undisturbed)


@pytest.mark.unchecked
def test_time_and_memory_add_up_over_stops(tmp_path: Path) -> None:
    """Time, peak memory, records and steps count the processes before a stop."""
    for last in (2, 4):  # the second process takes four steps, up to step 6
        pytest.raises(KeyboardInterrupt, train_until_step, tmp_path, last, interrupt)
    path = checkpoint_files(tmp_path / "checkpoints")[-1]
    assert path.stem == "step_0000006"
    tensors = read_tensors(path)
    before = 1e6 + float(tensors["seconds"])
    assert before - 1e6 > sum(tensors["curves.step_ms"].tolist()) / 1000 > 0
    told = {"seconds": before, "peak_memory_mb": 7e6, "gpu_memory_mb": 5e3}
    changed = {name: torch.tensor(value, dtype=torch.float64) for name, value in told.items()}
    write_tensors(path, tensors | changed, {"format": "mien.checkpoint", "version": "1"})
    train_toy.main(tmp_path, STEPS)
    summary, curves = read_training_summary(tmp_path), read_curves(tmp_path)
    assert round(before, 1) <= summary["seconds"] < 2e6, "counted on, not anew and not twice"
    assert (summary["steps"], summary["peak_memory_mb"], summary["gpu_memory_mb"]) == (STEPS, 7e6, 5e3)
    assert curves["step"].tolist() == list(range(3, STEPS + 1, 3))
    assert curves["step_ms"][:2].tolist() == tensors["curves.step_ms"].tolist()


@pytest.mark.unchecked
def test_finished_run_is_loaded_and_other_settings_are_refused(undisturbed: Path, capsys) -> None:
    before = (undisturbed / "training.json").read_bytes()
    train_toy.main(undisturbed, STEPS)
    assert "step" not in capsys.readouterr().out
    assert (undisturbed / "training.json").read_bytes() == before
    summary = read_training_summary(undisturbed)
    assert summary["steps"] == STEPS
    assert set(summary) == {"steps", "seconds", "gaussians", "step_ms_median", "peak_memory_mb"}
    refuses("settings.steps", train_toy.main, undisturbed, STEPS + 1)
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    with pytest.raises(UserError, match="method"):
        train([sequence], face_model, replace(train_toy.CONFIG, sh_degree=1), train_toy.SETTINGS, undisturbed)


@pytest.mark.unchecked
@pytest.mark.exact
def test_threads_do_not_change_a_bit() -> None:
    """In whole steps with enough Gaussians to divide every native loop."""

    def trained() -> dict[str, torch.Tensor]:
        state, data = training_case(load_face_model(), 6000, 128, 160)
        for _ in range(3):
            step(state, data, BENCHMARK_SETTINGS)
        store = state.avatar.store
        tensors = {name: store[name].detach().clone() for name in store.names()}
        tensors |= {f"{name}.second": moments.second for name, moments in store.moments.items()}
        assert state.density is not None
        return tensors | state.density.state() | state.track.state()

    first, *others = by_threads(trained, (1, 2, 3))
    for name, tensor in first.items():
        assert all(torch.equal(tensor, other[name]) for other in others), name


def test_leaves_that_take_their_gradients_themselves_have_the_same() -> None:
    """Two losses share a leaf, of which one is native; what is no leaf is left to PyTorch."""
    means, scales, radii = random(100, 3), random(100, 3, seed=1), torch.arange(100, dtype=torch.int32) % 3
    found = []
    for way in (nullcontext, direct_gradients):
        leaves = [means.clone().requires_grad_(), scales.clone().requires_grad_()]
        pairs = [
            triangle_penalties(leaves[0], own, radii, (1.0, 0.6), (0.01, 1.0)) for own in (leaves[1], 2 * leaves[1])
        ]
        with way():
            torch.autograd.backward([*pairs[0], *pairs[1], leaves[0].square().sum()])
        found.append([known(leaf.grad) for leaf in leaves])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)
        assert one.any()
