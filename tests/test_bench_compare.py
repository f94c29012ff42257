"""`mien bench compare` trains methods on the same frames with the same budget, continues, and writes one table."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mien.avatar.methods import METHODS
from mien.cli import main
from mien.commands.bench import Compare
from mien.disk.workspace import Workspace
from mien.face.loading import add_face_model
from mien.lab.benchmarking.comparing import MethodRow, comparison_table, unseen_mean
from mien.pipeline import comparing
from mien.pipeline.comparing import Budget, CompareSettings
from mien.training import PRESETS, trainer
from mien.training.run import read_run_config, read_training_summary
from toy_scene import toy_face_model
from toy_workspace import write_toy_workspace

pytestmark = pytest.mark.unchecked
METRICS = {"psnr": 30.0, "ssim": 0.9, "l1": 0.01, "perceptual": 0.2}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("compared")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("MIEN_CACHE", str(folder / "cache"))
        add_face_model(toy_face_model(), folder / "toy.npz", "none")
        write_toy_workspace(folder / "anna")
        yield folder / "anna"


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the folders of the runs that are really trained, in order."""
    seen: list[Path] = []
    write = trainer.write_results
    monkeypatch.setattr(trainer, "write_results", lambda *given: seen.append(given[0]) or write(*given))
    return seen


@pytest.mark.slow
@pytest.mark.usefixtures("short_films")
def test_methods_get_the_same_frames_and_steps(workspace: Path, tmp_path: Path, trained: list[Path], capsys) -> None:
    assert Compare().methods == tuple(METHODS)
    methods = ("gaussian_avatars", "textured_mesh")
    command = ["bench", "compare", str(workspace), "--steps", "3", "--split", "tail", "--out", str(tmp_path)]
    assert main([*command, "--methods", "gaussian_avatars"]) == 0
    command += ["--methods", *methods]
    assert main([*command, "--json"]) == 0
    assert [folder.name for folder in trained] == [f"compare-{method}-3-tail" for method in methods]
    content = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = content["rows"]
    assert content["format"] == "mien.bench_compare"
    assert json.loads((tmp_path / "compare.json").read_text())["rows"] == rows
    assert [(row["capture"], row["method"], row["steps"]) for row in rows] == [("anna", m, 3) for m in methods]
    scored_on = []
    for row in rows:
        entry = row["protocols"]["self_reenactment_tail"]
        assert "per_frame" not in entry
        assert row["gaussians"] > 0 <= row["seconds"]
        assert entry["head"]["psnr"] > 0
        run_dir = workspace / "runs" / row["run"]
        assert row["bytes_on_disk"] == sum(path.stat().st_size for path in (run_dir / "avatar").iterdir())
        frames = json.loads((run_dir / "metrics.json").read_text())["protocols"]["self_reenactment_tail"]["per_frame"]
        scored_on.append((entry["scored_on"], frames["timestep"], read_run_config(run_dir)["settings"]["steps"]))
    assert scored_on[0] == scored_on[1]
    table = (tmp_path / "compare.md").read_text()
    assert table.startswith("| capture | protocol | method | head: PSNR, dB |")
    assert "unseen" not in table
    assert all(f"| {method} |" in table for method in methods)
    assert main(command) == 0
    assert len(trained) == 2
    assert table.strip() in capsys.readouterr().out


@pytest.mark.usefixtures("short_films")
def test_minutes_become_steps_by_trials_that_are_kept(workspace: Path, tmp_path: Path, trained, monkeypatch) -> None:
    """On a clock on which a step takes a tenth of a second, 3 seconds are 30 steps."""
    reads = itertools.count(1)
    monkeypatch.setattr(trainer, "time", SimpleNamespace(perf_counter=lambda: next(reads) / 10))
    monkeypatch.setattr(comparing, "FIRST_TRIAL_STEPS", 5)
    run = "compare-gaussian_avatars-0.05min-tail"
    command = ["bench", "compare", str(workspace), "--minutes", "0.05", "--methods", "gaussian_avatars"]
    command += ["--out", str(tmp_path), "--split", "tail"]
    assert main(command) == 0
    assert read_training_summary(workspace / "runs" / run)["steps"] == 30
    assert [folder.name.rpartition("-")[0] for folder in trained] == ["first-5", "second-10", run.rpartition("-")[0]]
    assert trained[0].parent == tmp_path / "trials" / "anna" / run
    assert main(command) == 0
    assert len(trained) == 3


def test_what_two_trials_share_is_not_counted_for_each_step(workspace: Path, tmp_path: Path, monkeypatch, capsys):
    """A run prepares much before its first step, and the first use of each frame takes longest."""
    times, asked = {100: 10.0, 200: 14.0, 60: 10.0}, []

    def trial(subject: Any, config: Any, settings: Any, folder: Path) -> float:
        asked.append(settings.steps)
        return times[settings.steps]

    monkeypatch.setattr(comparing, "trial_seconds", trial)
    chosen = CompareSettings(("gaussian_avatars",), "standard", Budget(minutes=2.0), "tail")
    subject = comparing.of_workspace(Workspace(workspace), chosen)
    config = PRESETS["standard"].config("gaussian_avatars")

    def steps_for(budget: Budget) -> int:
        return comparing.steps_for(subject, config, subject.settings, budget, tmp_path / "new")

    assert steps_for(chosen.budget) == 114 / 0.04  # 6 s beside the steps, and 40 ms for each
    assert asked == [100, 200]
    times[200] = 9.0  # The machine was busier in the first trial: a step takes at least 0.3 of the mean.
    assert steps_for(chosen.budget) == round(113.7 / 0.0135)
    assert steps_for(Budget(minutes=0.2)) == 120  # There is no time for a second trial.
    assert "too few steps" not in capsys.readouterr().err
    assert steps_for(Budget(minutes=0.002)) == 1
    assert "0.002 minutes are too few steps to see each of" in capsys.readouterr().err
    assert (steps_for(Budget(steps=7)), steps_for(Budget())) == (7, subject.settings.steps)


def row(capture: str, method: str, psnr: float, unseen: dict[str, Any] | None = None, **parts: Any) -> MethodRow:
    entry = {**METRICS, "psnr": psnr + 3, "head": {**METRICS, "psnr": psnr}, "seconds_per_frame": 0.0123, **parts}
    return MethodRow(capture, method, "run", 2000, 90.0, 12345, 3_456_789, {"self_reenactment": entry}, unseen or {})


def test_the_table_marks_the_best_and_means_over_shared_captures() -> None:
    eyes = {"eyes": {**METRICS, "psnr": 25.0}}
    views = {angle: {"avatar": {"head": {**METRICS, "psnr": psnr}}} for angle, psnr in (("front", 40.0), ("30", 22.0))}
    rows = [row("one", "a", 20.0, **eyes), row("one", "b", 21.0), row("two", "a", 30.0, views), row("two", "b", 26.0)]
    heads, _, *cells = (
        [cell.strip() for cell in line[1:-1].split("|")] for line in comparison_table(rows).splitlines()
    )
    columns = dict(zip(heads, zip(*cells, strict=True), strict=True))
    assert columns["head: PSNR, dB"] == ("20.00", "**21.00**", "**30.00**", "26.00", "**25.00**", "23.50")
    assert columns["eyes: PSNR"] == ("25.00", "-", "-", "-", "-", "-")
    assert columns["unseen views: PSNR"] == ("-", "-", "22.00", "-", "-", "-")
    assert "mouth: PSNR" not in columns
    assert cells[4][:3] == ["mean of 2", "all", "a"]
    names = ("Gaussians", "training, min", "ms a frame", "MB on disk")
    assert [columns[name][0] for name in names] == ["12,345", "1.5", "12.3", "3.5"]
    assert unseen_mean(views, "psnr") == 22
    assert unseen_mean({}, "psnr") is None
    assert "mean of" not in comparison_table(rows[:3]), "captures that a method lacks do not count in the means"


def test_bad_options_are_told_in_one_line(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more, told in (
        ([], "nothing to compare on"),
        ([str(workspace), "--minutes", "-1"], "--minutes -1: give a number from 0"),
        ([str(workspace), "--steps", "-1"], "--steps -1"),
        ([str(workspace.parent / "gone")], "no such folder"),
        ([str(workspace), "--steps", "5", "--minutes", "1"], "give one of them"),
        ([str(workspace), str(workspace)], "two captures have this name"),
        ([str(workspace), "--methods", "nerf"], "instead of 'nerf'"),
        (["--captures", "mono"], "mono-short"),
    ):
        assert main(["bench", "compare", *more, "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert told in line, line
    assert not (tmp_path / "out").exists()
