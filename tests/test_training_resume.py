"""A run that is stopped at any moment and started again ends with the same bytes as an uninterrupted one."""

import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

import train_toy
from forked import ForkServer
from instruction_sets import by_threads
from mien.avatar import Avatar
from mien.disk.files import read_tensors, write_tensors
from mien.errors import UserError
from mien.face import load_face_model
from mien.lab.benchmarking.train_step import SETTINGS as BENCHMARK_SETTINGS
from mien.lab.benchmarking.train_step import training_case
from mien.machine.stops import Terminated
from mien.training import train
from mien.training.checkpoint import checkpoint_files
from mien.training.run import read_curves, read_training_summary
from mien.training.trainer import step
from refusals import refuses
from toy_scene import toy_sequence

pytestmark = pytest.mark.unchecked
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
def test_a_stop_leaves_a_checkpoint_of_its_step(number, kind, tmp_path, undisturbed) -> None:
    """Also before the first record, when its curves are empty."""
    for last, stopped in ((1, 1), (6, 7)):
        pytest.raises(kind, train_until_step, tmp_path, last, partial(signal.raise_signal, number))
        assert steps_of_checkpoints(tmp_path)[-1] == stopped
    train_toy.main(tmp_path, STEPS)
    assert_same_results(tmp_path, undisturbed)


def test_time_and_memory_add_up_over_stops(tmp_path: Path) -> None:
    """What a run sums up over its steps counts the processes before a stop: time, peak memory, records, steps."""
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
