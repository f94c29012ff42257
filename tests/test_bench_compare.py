"""`mien bench compare` trains with the same budget; `mien bench quality` measures the error that there is."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from capture_helpers import random_capture
from mien.avatar.methods import METHODS
from mien.cli import main
from mien.commands.bench import Compare
from mien.disk.workspace import Workspace
from mien.face.loading import add_face_model
from mien.lab.benchmarking import quality
from mien.lab.benchmarking.comparing import MethodRow, comparison_table, unseen_mean
from mien.lab.synthetic import RECIPES
from mien.lab.synthetic.recipe import Segment
from mien.lab.synthetic.scene import SyntheticScene
from mien.lab.synthetic.truth import Truth, truth_of
from mien.pipeline import comparing
from mien.render.mesh import vertex_normals
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.tracking import Tracking
from mien.training import PRESETS, trainer
from mien.training.run import read_run_config, read_training_summary
from refusals import complaint
from shared_things import write_toy_workspace
from small_face_model import make_small_face_model
from toy_scene import toy_face_model
from tracking_case import still_camera

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
    command += ["--device", "auto"]
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
        assert read_run_config(run_dir)["settings"]["device"] == "auto"
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
    """On a clock on which a step takes a tenth of a second, 3 seconds are 30 steps.

    The second trial has 6 frames more than the first one and 4 steps, as late steps have one frame and others two.
    """
    reads = itertools.count(1)
    monkeypatch.setattr(trainer, "time", SimpleNamespace(perf_counter=lambda: next(reads) / 10))
    monkeypatch.setattr(comparing, "FIRST_TRIAL_STEPS", 6)
    run = "compare-gaussian_avatars-0.05min-tail"
    command = ["bench", "compare", str(workspace), "--minutes", "0.05", "--methods", "gaussian_avatars"]
    command += ["--out", str(tmp_path), "--split", "tail"]
    assert main(command) == 0
    assert read_training_summary(workspace / "runs" / run)["steps"] == 45
    assert [folder.name.rpartition("-")[0] for folder in trained] == ["first-6", "second-12", run.rpartition("-")[0]]
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
    subject = comparing.of_workspace(Workspace(workspace), "tail")
    config = PRESETS["standard"].config("gaussian_avatars")

    def steps_for(minutes: float = 0.0, steps: int = 0) -> int:
        return comparing.steps_for(subject, config, subject.settings, minutes, steps, tmp_path / "new")

    assert steps_for(2.0) == 114 / 0.04  # 6 s beside the steps, and 40 ms for each
    assert asked == [100, 200]
    times[200] = 9.0  # The machine was busier in the first trial: a step takes at least 0.3 of the mean.
    assert steps_for(2.0) == round(113.7 / 0.0135)
    assert steps_for(0.2) == 120  # There is no time for a second trial.
    assert "too few steps" not in capsys.readouterr().err
    assert steps_for(0.002) == 1
    assert "0.002 minutes are too few steps to see each of" in capsys.readouterr().err
    assert (steps_for(steps=7), steps_for()) == (7, subject.settings.steps)


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
    assert columns["L1"][0] == "**0.0100**"
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
        ([str(workspace), "--steps", "-1"], "--steps -1"), ([str(workspace.parent / "gone")], "no such folder"),
        ([str(workspace), "--steps", "5", "--minutes", "1"], "give one of them"),
        ([str(workspace), str(workspace)], "two captures have this name"),
        ([str(workspace), "--methods", "nerf"], "instead of 'nerf'"), (["--captures", "mono"], "mono-short"),
    ):  # fmt: skip
        assert told in complaint(capsys, "bench", "compare", *more, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


RECIPE = replace(
    RECIPES["demo"], width=128, height=128, fps=10.0, glasses=False, hair="none",
    texture_size=512, script=(Segment("free", 1.0), Segment("still", 1.5)),
)  # fmt: skip


@pytest.fixture(scope="module")
def case():
    scene = SyntheticScene(RECIPE, 3)
    truth, t = truth_of(scene), RECIPE.timesteps
    images, mattes = np.zeros((t, 1, 128, 128, 3), np.uint8), np.zeros((t, 1, 128, 128), np.uint8)
    capture = replace(
        random_capture(t, 1), images=images, mattes=mattes, landmarks=truth.landmarks, source={}, fps=10.0
    )
    return scene, replace(capture, valid=np.ones((t, 1), bool)), truth


def test_the_truth_has_no_error(case):
    scene, capture, truth = case
    errors = quality.tracking_errors(truth.tracking, capture, truth, scene.model)
    for name, most in {
        "vertex_mm": 0.02, "landmark_px": 0.05, "rotation_deg": 0.05, "jitter_px": 0.01, "jitter_mm": 0.01,
        "iris_deviation_percent": 0.7,
    }.items():  # fmt: skip
        assert getattr(errors, name) < most, name
    assert errors.turns is None or abs(errors.turns.loss_percent) < 0.1
    # A constant turn is not unsteady.
    face = truth.tracking.face
    still, turned = (
        replace(truth.tracking, face=replace(face, head_rotation=0 * face.head_rotation + torch.tensor([0, yaw, 0])))
        for yaw in (0.0, 0.1)
    )
    errors = quality.tracking_errors(turned, capture, replace(truth, tracking=still), scene.model)
    assert errors.rotation_deg == pytest.approx(np.degrees(0.1), abs=1e-2)
    assert errors.rotation_steady_deg < 0.05
    # Another expression is a distance, and noise is jitter.
    face, random = truth.tracking.face, torch.Generator().manual_seed(0)
    open_mouth = face.expression.clone()
    open_mouth[:, scene.model.expression_names.index("jawOpen")] += 0.5
    shift = 0.002 * torch.randn(len(face), 3, generator=random)
    worse = replace(face, expression=open_mouth, head_translation=face.head_translation + shift)
    errors = quality.tracking_errors(replace(truth.tracking, face=worse), capture, truth, scene.model)
    assert 1 < errors.vertex_mm < 10
    assert (errors.jitter_px or 0) > 0.3
    assert 2 < (errors.jitter_mm or 0) < 20
    # The truth follows the capture's crop.
    cropped = replace(capture, source={"crop": {"left": 32, "top": 16, "width": 64, "height": 32}})
    moved = quality.crop_landmarks(truth.landmarks, cropped)
    np.testing.assert_allclose(moved, (truth.landmarks - [32, 16]) * [2, 4], rtol=1e-5)


@pytest.mark.parametrize("yaw", [0.0, 1.2, -1.2])
def test_vertices_that_do_not_face_the_camera_are_left_out(case, yaw):
    """A vertex counts if the cosine of its normal and the direction to a camera is above 0.2."""
    scene, _, truth = case
    rotation = torch.tensor([0.0, yaw, 0.0]).expand_as(truth.tracking.face.head_rotation)
    face = replace(truth.tracking.face, head_rotation=rotation)
    turned = replace(truth, tracking=replace(truth.tracking, face=face))
    vertices = scene.model(face[0])
    towards = truth.tracking.cameras[0].position - vertices[0]
    cosine = (vertex_normals(vertices, scene.model.faces)[0] * towards).sum(-1) / towards.norm(dim=-1)
    cosine, visible = cosine.numpy()[truth.vertex_index], quality.visible_vertices(turned, scene.model, 0)
    # Normals at the region's rim differ, since the benchmark takes the region's triangles only.
    assert visible[cosine > 0.22].mean() > 0.98
    assert visible[cosine < 0.18].mean() < 0.03


def test_distances_do_not_see_rotation_scale_and_shift():
    random = np.random.default_rng(0)
    points = random.normal(size=(50, 3))
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    assert quality.aligned_distance(3 * points @ turn.T + 5, points) < 1e-9
    assert quality.aligned_distance(points @ turn.T + 5, points, rigid=True) < 1e-9
    assert quality.aligned_distance(3 * points @ turn.T + 5, points, rigid=True) > 1  # a wrong scale counts there
    assert quality.aligned_distance(points * [1, 1, -1], points) > 0.1  # but they do see a mirror


def test_the_table_names_key_and_baselines(tmp_path, capsys):
    figures = {"psnr": 30.0, "ssim": 0.9, "l1": 0.01, "perceptual": None}
    figures = {**figures, "head": dict(figures)}
    protocols = {"novel_view": {**figures, "baselines": {"mean_frame": figures, "mesh": figures}}}
    errors = {"a": quality.TrackingErrors(1.0, 2.0, 3.0, 0.5, None)}
    table = quality.markdown_table(
        [quality.QualityRow("ring-16", "abcd", "a_method", 10, 99, protocols, errors, {"draw": 1.0})]
    )
    assert "ring-16 (`abcd`) | novel_view | avatar | 30.00 / 0.900 / 0.0100 / - |" in table
    assert "mean frame" in table
    assert "| mesh |" in table
    assert "1.00 mm | 2.00 px | 3.00 (0.50) deg | - | - | - | - |" in table
    known = quality.TrackingErrors(1.0, 2.0, 3.0, 0.5, 0.02, 0.04, quality.Following(0.3, 7.0, 5), None, 0.61)
    assert quality.tracking_cells(known)[-4:] == ["0.020 px, 0.040 mm", "0.30 frames, 7 % (5)", "-", "0.61 %"]
    # An unknown capture is told.
    assert "mono-short" in complaint(capsys, "bench", "quality", "--captures", "mono", "--out", str(tmp_path))


FPS = 25.0
TIME = np.arange(100.0)


def bumps(delay: float = 0.0, height: float = 1.0, width: float = 2.0) -> np.ndarray:
    """Return the coefficient of two blinks over time."""
    return height * np.stack([np.exp(-(((TIME - at - delay) / width) ** 2)) for at in (30.0, 62.0)]).sum(0)


def found_in(values: np.ndarray) -> quality.Following:
    found = quality.following(values[:, None], bumps()[:, None], bumps() > 0.3, 6)
    assert found is not None
    return found


def test_delay_and_height_are_found_in_coefficients_and_in_turns():
    for delay, height in [(-1.3, 0.8), (0.0, 1.0), (0.6, 1.1), (2.0, 0.8)]:
        found = found_in(5 + bumps(delay, height))
        assert found.lag_frames == pytest.approx(delay, abs=0.1)
        assert (found.loss_percent, found.events) == (pytest.approx(100 * (1 - height), abs=2), 2)
    # Where nothing happens there is nothing to measure, and an event that was not tracked is left out.
    assert quality.following(bumps()[:, None], bumps()[:, None], np.zeros(len(TIME), bool), 6) is None
    gap = bumps()
    gap[28:33] = np.nan
    assert found_in(gap).events == 1
    _, truth = exact_of(turns())
    off = matrix_from_axis_angle(torch.tensor([0.05, 0.1, -0.08]))
    late = axis_angle_from_matrix(matrix_from_axis_angle(turns(1.5, 0.9)) @ off.T)
    found = quality.turn_following(exact_of(late)[0], truth, FPS)
    assert found is not None
    assert found.lag_frames == pytest.approx(1.5, abs=0.1)
    assert found.loss_percent == pytest.approx(10, abs=2)
    assert quality.turn_following(exact_of(turns())[0], exact_of(0 * turns())[1], FPS) is None


def exact_of(rotations: torch.Tensor) -> tuple[Tracking, Truth]:
    face = replace(make_small_face_model().neutral(len(rotations)), head_rotation=rotations)
    tracking = Tracking(
        face_model="small", face_model_hash="", face=face, valid=torch.ones(len(rotations)).bool(),
        cameras=(still_camera().to(torch.zeros(())),), neck_lines=torch.zeros(len(rotations), 1, 3),
        residuals=torch.zeros(len(rotations), 1),
    )  # fmt: skip
    nothing = np.zeros((len(rotations), 1, 478, 2), np.float32)
    return tracking, Truth(tracking, np.zeros(1, np.int64), np.zeros((len(rotations), 1, 3), np.float32), nothing)


def turns(delay: float = 0.0, share: float = 1.0) -> torch.Tensor:
    """Return pitch and yaw that turn and come back, at 60 degrees a second at most."""
    angle = share * np.stack([0.1 * bumps(delay, width=5.0), 0.4 * bumps(delay, width=5.0), 0 * TIME], axis=1)
    return torch.from_numpy(angle).float()


def test_blinks_are_seen_in_the_lids():
    open_eyes = np.random.default_rng(0).uniform(100, 200, (1, 1, 478, 2)).repeat(len(TIME), 0)
    _, truth = exact_of(0 * turns())

    def blinking(delay: float, depth: float) -> np.ndarray:
        points = open_eyes.copy()
        for upper, lower in quality.LIDS:
            share = depth * bumps(delay)[:, None, None]
            points[:, :, upper] += share * (points[:, :, lower] - points[:, :, upper])
        return points

    true, tracked = blinking(0.0, 0.9), blinking(1.0, 0.6)
    assert quality.eye_opening(true[:, 0]).min() < 0.2 * quality.eye_opening(true[:, 0]).max()
    found = quality.blink_following(tracked, true, truth, FPS)
    assert found is not None
    assert (found.events, found.lag_frames) == (2, pytest.approx(1.0, abs=0.1))
    assert found.loss_percent == pytest.approx(100 * (1 - 0.6 / 0.9), abs=3)
    assert quality.blink_following(tracked, open_eyes, truth, FPS) is None
    # Jitter counts where the truth stands still.
    true = np.zeros((20, 1, 478, 2), np.float32)
    true[10:] += np.arange(10)[:, None, None, None]
    still = quality.still_timesteps(true)
    assert (still[:8].all(), still[9:].any()) == (True, False)
    points = np.zeros((20, 478, 3))
    points[1::2, :, 0] = 0.001
    points[12:] = 50 * np.random.default_rng(0).standard_normal((8, 478, 3))
    assert quality.jitter(points, still) == pytest.approx(0.002)
    assert quality.jitter(points, np.zeros(18, bool)) is None
