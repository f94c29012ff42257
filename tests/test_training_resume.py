"""A run that is stopped at any moment and started again ends with the same bytes as an uninterrupted one."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import train_toy
from mien import _native
from mien.benchmarking.train_step import SETTINGS as BENCHMARK_SETTINGS
from mien.benchmarking.train_step import training_case
from mien.errors import UserError
from mien.face import load_face_model
from mien.training import read_curves, read_training_summary, train
from mien.training.checkpoint import checkpoint_files
from mien.training.trainer import step
from toy_scene import toy_sequence

STEPS = train_toy.SETTINGS.steps
RESULTS = ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("undisturbed")
    train_toy.main(run_dir, STEPS)
    return run_dir


def train_until(run_dir: Path, signal_at_step: int, signal_number: int) -> tuple[int, int]:
    """Train in another process until a step, and send it a signal. Return its exit code and its first step."""
    script = Path(train_toy.__file__)
    process = subprocess.Popen(
        [sys.executable, str(script), str(run_dir), str(STEPS)], stdout=subprocess.PIPE, text=True, cwd=script.parent
    )
    assert process.stdout is not None
    began = -1
    with process.stdout:
        for line in process.stdout:
            word, number = line.split()
            began = int(number) if word == "start" else began
            if word == "step" and int(number) == signal_at_step:
                process.send_signal(signal_number)
    return process.wait(), began


def assert_same_results(run_dir: Path, undisturbed: Path) -> None:
    for name in RESULTS:
        assert (run_dir / name).read_bytes() == (undisturbed / name).read_bytes(), f"{name} differs"
    ours, theirs = read_curves(run_dir), read_curves(undisturbed)
    for name in set(theirs) - {"step_ms"}:
        assert ours[name].tolist() == theirs[name].tolist(), f"curve {name} differs"


def test_killed_runs_end_with_the_same_bytes(tmp_path: Path, undisturbed: Path) -> None:
    # Stop before the first checkpoint, during density control, and again after resuming.
    for kill_at in (2, 13, 22):
        code, _ = train_until(tmp_path, kill_at, signal.SIGKILL)
        assert code == -signal.SIGKILL
    (tmp_path / "checkpoints" / ".step_0000024.safetensors.x.safetensors").write_bytes(b"half a checkpoint")
    train_toy.main(tmp_path, STEPS)
    assert_same_results(tmp_path, undisturbed)
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2


def test_interrupt_leaves_a_checkpoint_of_the_step_it_came_in(tmp_path: Path, undisturbed: Path) -> None:
    code, _ = train_until(tmp_path, 6, signal.SIGINT)
    assert code != 0
    last = checkpoint_files(tmp_path / "checkpoints")[-1]
    assert last.stem >= "step_0000006"
    code, began = train_until(tmp_path, -1, signal.SIGKILL)
    assert (code, began) == (0, int(last.stem.removeprefix("step_")))
    assert_same_results(tmp_path, undisturbed)


def test_goes_on_from_the_older_checkpoint_if_the_newest_is_damaged(tmp_path: Path, undisturbed: Path) -> None:
    train_until(tmp_path, 18, signal.SIGKILL)
    newest = checkpoint_files(tmp_path / "checkpoints")[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    train_toy.main(tmp_path, STEPS)
    assert_same_results(tmp_path, undisturbed)


def test_finished_run_is_loaded(undisturbed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (undisturbed / "training.json").read_bytes()
    train_toy.main(undisturbed, STEPS)
    assert "step" not in capsys.readouterr().out
    assert (undisturbed / "training.json").read_bytes() == before
    summary = read_training_summary(undisturbed)
    assert summary["steps"] == STEPS
    assert set(summary) == {"steps", "seconds", "gaussians", "step_ms_median", "peak_memory_mb"}


@pytest.mark.exact
def test_threads_do_not_change_a_bit() -> None:
    """The number of threads does not change a bit, in whole steps with enough Gaussians to divide every native loop."""
    results = []
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for threads in (1, 2, 3):
            _native.set_thread_count(threads)
            state, data = training_case(load_face_model(), 6000, 128, 160)
            for _ in range(8):
                step(state, data, BENCHMARK_SETTINGS)
            store = state.avatar.gaussian_store()
            tensors = {name: store[name].detach().clone() for name in store.names()}
            tensors |= {f"{name}.second": moments.second for name, moments in store.moments.items()}
            results.append(tensors | state.density.state() | state.track.state())
    finally:
        _native.set_thread_count(0)
        torch.set_num_threads(before)
    for other in results[1:]:
        for name, tensor in results[0].items():
            assert torch.equal(tensor, other[name]), name


def test_other_settings_are_refused(undisturbed: Path) -> None:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    with pytest.raises(UserError, match="settings.steps"):
        train_toy.main(undisturbed, STEPS + 1)
    other = train_toy.CONFIG.__class__(sh_degree=1)
    with pytest.raises(UserError, match="method"):
        train([sequence], face_model, other, train_toy.SETTINGS, undisturbed)
