"""`mien bench compare` trains methods on the same frames with the same budget, continues, and writes one table."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mien.avatar import METHODS
from mien.cli import main
from mien.commands.bench import Compare
from mien.commands.stages import comparing
from mien.commands.stages.comparing import Budget, CompareSettings
from mien.face import add_face_model
from mien.lab.benchmarking.comparing import MethodRow, comparison_table, unseen_mean
from mien.training import PRESETS, read_run_config, read_training_summary, trainer
from mien.workspace import Workspace
from toy_scene import toy_face_model
from toy_workspace import write_toy_workspace

pytestmark = pytest.mark.unchecked
METRICS = {"psnr": 30.0, "ssim": 0.9, "l1": 0.01, "perceptual": 0.2}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a tracked workspace whose face model is in the cache, as that of a user."""
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

    def watched(run_dir: Path, *more: Any) -> None:
        seen.append(run_dir)
        write(run_dir, *more)

    monkeypatch.setattr(trainer, "write_results", watched)
    return seen


@pytest.mark.slow
@pytest.mark.usefixtures("short_films")
def test_methods_get_the_same_frames_and_steps(
    workspace: Path, tmp_path: Path, trained: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert Compare().methods == tuple(METHODS)
    methods = ("gaussian_avatars", "textured_mesh")
    command = ["bench", "compare", str(workspace), "--steps", "3", "--split", "tail", "--out", str(tmp_path)]
    assert main([*command, "--methods", "gaussian_avatars"]) == 0
    command += ["--methods", *methods]
    assert main([*command, "--json"]) == 0
    assert [folder.name for folder in trained] == [f"compare-{method}-3-tail" for method in methods]
    content = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert content["format"] == "mien.bench_compare"
    rows = content["rows"]
    assert [(row["capture"], row["method"], row["steps"]) for row in rows] == [("anna", m, 3) for m in methods]
    stored = json.loads((tmp_path / "compare.json").read_text())
    assert stored["rows"] == rows
    scored_on = []
    for row in rows:
        entry = row["protocols"]["self_reenactment_tail"]
        assert row["gaussians"] > 0
        assert row["seconds"] >= 0
        assert entry["head"]["psnr"] > 0
        assert "per_frame" not in entry
        run_dir = workspace / "runs" / row["run"]
        assert row["bytes_on_disk"] == sum(path.stat().st_size for path in (run_dir / "avatar").iterdir())
        frames = json.loads((run_dir / "metrics.json").read_text())["protocols"]["self_reenactment_tail"]["per_frame"]
        scored_on.append((entry["scored_on"], frames["timestep"], read_run_config(run_dir)["settings"]["steps"]))
    assert all(each == scored_on[0] for each in scored_on)
    table = (tmp_path / "compare.md").read_text()
    assert table.startswith("| capture | protocol | method | head: PSNR, dB |")
    assert "unseen" not in table
    assert all(f"| {method} |" in table for method in methods)
    before = len(trained)
    assert main(command) == 0
    assert len(trained) == before
    assert table.strip() in capsys.readouterr().out


class TenthsOfSeconds:
    """A clock that goes on by a tenth of a second whenever it is read."""

    def __init__(self) -> None:
        self.reads = 0

    def perf_counter(self) -> float:
        self.reads += 1
        return self.reads / 10


@pytest.mark.usefixtures("short_films")
def test_minutes_become_steps_by_trials_that_are_kept(
    workspace: Path, tmp_path: Path, trained: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a clock on which a step takes a tenth of a second, 3 seconds are 30 steps."""
    monkeypatch.setattr(trainer, "time", TenthsOfSeconds())
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


def test_what_two_trials_share_is_not_counted_for_each_step(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run prepares much before its first step, and the first use of each frame takes longest."""
    times, asked = {100: 10.0, 200: 14.0, 60: 10.0}, []

    def trial(subject: Any, config: Any, settings: Any, folder: Path) -> float:
        asked.append(settings.steps)
        return times[settings.steps]

    monkeypatch.setattr(comparing, "trial_seconds", trial)
    chosen = CompareSettings(("gaussian_avatars",), "standard", Budget(minutes=2.0), "tail")
    subject = comparing.of_workspace(Workspace(workspace), chosen)
    config = PRESETS["standard"].config("gaussian_avatars")
    # 6 s beside the steps, and 40 ms for each.
    assert comparing.steps_for(subject, config, subject.settings, chosen.budget, tmp_path / "new") == 114 / 0.04
    assert asked == [100, 200]
    times[200] = 9.0  # The machine was busier in the first trial: a step takes at least 0.3 of the mean.
    assert comparing.steps_for(subject, config, subject.settings, chosen.budget, tmp_path / "new") == round(
        113.7 / 0.0135
    )
    # There is no time for a second trial.
    assert comparing.steps_for(subject, config, subject.settings, Budget(minutes=0.2), tmp_path / "new") == 120
    assert "too few steps" not in capsys.readouterr().err
    assert comparing.steps_for(subject, config, subject.settings, Budget(minutes=0.002), tmp_path / "new") == 1
    assert "0.002 minutes are too few steps to see each of" in capsys.readouterr().err
    assert comparing.steps_for(subject, config, subject.settings, Budget(steps=7), tmp_path / "new") == 7
    assert comparing.steps_for(subject, config, subject.settings, Budget(), tmp_path / "new") == subject.settings.steps


def row(capture: str, method: str, psnr: float, unseen: dict[str, Any] | None = None, **parts: Any) -> MethodRow:
    entry = {**METRICS, "psnr": psnr + 3, "head": {**METRICS, "psnr": psnr}, "seconds_per_frame": 0.0123, **parts}
    return MethodRow(capture, method, "run", 2000, 90.0, 12345, 3_456_789, {"self_reenactment": entry}, unseen or {})


def test_the_table_marks_the_best_and_means_over_shared_captures() -> None:
    eyes = {"eyes": {**METRICS, "psnr": 25.0}}
    views = {angle: {"avatar": {"head": {**METRICS, "psnr": psnr}}} for angle, psnr in (("front", 40.0), ("30", 22.0))}
    rows = [row("one", "a", 20.0, **eyes), row("one", "b", 21.0), row("two", "a", 30.0, views), row("two", "b", 26.0)]
    table = comparison_table(rows).splitlines()
    heads = [cell.strip() for cell in table[0].strip("|").split("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table[2:]]
    head, eyes_at, unseen = (heads.index(name) for name in ("head: PSNR, dB", "eyes: PSNR", "unseen views: PSNR"))
    assert [line[head] for line in cells] == ["20.00", "**21.00**", "**30.00**", "26.00", "**25.00**", "23.50"]
    assert [line[eyes_at] for line in cells] == ["25.00", "-", "-", "-", "-", "-"]
    assert [line[unseen] for line in cells] == ["-", "-", "22.00", "-", "-", "-"]
    assert "mouth: PSNR" not in heads
    assert cells[4][:3] == ["mean of 2", "all", "a"]
    assert cells[0][heads.index("Gaussians")] == "12,345"
    assert cells[0][heads.index("training, min")] == "1.5"
    assert cells[0][heads.index("ms a frame")] == "12.3"
    assert cells[0][heads.index("MB on disk")] == "3.5"
    assert unseen_mean(views, "psnr") == 22
    assert unseen_mean({}, "psnr") is None


def test_captures_that_a_method_lacks_do_not_count_in_the_means() -> None:
    rows = [row("one", "a", 20.0), row("one", "b", 21.0), row("two", "a", 30.0)]
    assert "mean of" not in comparison_table(rows)


def test_bad_options_are_told_in_one_line(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more, told in (
        ([], "nothing to compare on"),
        ([str(workspace), "--minutes", "-1"], "--minutes -1: give a number from 0"),
        ([str(workspace), "--minutes", "nan"], "--minutes nan: give a number from 0"),
        ([str(workspace), "--steps", "-1"], "--steps -1"),
        ([str(workspace), "--steps", "5", "--minutes", "1"], "give one of them"),
        ([str(workspace), str(workspace)], "two captures have this name"),
        ([str(workspace), "--methods", "nerf"], "instead of 'nerf'"),
        ([str(workspace), "--preset", "paper", "--methods", "mono_gaussian_avatar"], "has no such preset"),
        (["--captures", "mono"], "mono-short"),
        ([str(tmp_path / "gone")], "no such folder"),
    ):
        if "paper" in more and "paper" in METHODS["mono_gaussian_avatar"].presets:
            continue
        assert main(["bench", "compare", *more, "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert told in line, line
    assert not (tmp_path / "out").exists()
