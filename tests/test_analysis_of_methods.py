"""`mien analyze headgas` and `mono-gaussian-avatar`: parts write their files; what they choose is as they say."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import train_toy
from capture_helpers import tree_bytes
from mien.avatar import Avatar, load_avatar
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.settings import GradientSettings, PerceptualLoss, Photometric
from mien.cli import main
from mien.gaussians import Gaussians
from mien.lab.analysis import headgas, headgas_ablations, measuring, mono_gaussian_avatar
from mien.lab.analysis.headgas import Trained, start_of_bases, trained_range, with_expression
from mien.lab.analysis.headgas_ablations import busy_face
from mien.lab.analysis.joining import joined_rows
from mien.lab.analysis.measuring import head_camera, mouth_camera
from mien.lab.analysis.registry import AnalysisOptions
from mien.lab.analysis.running import Context
from mien.media.video import count_frames
from mien.runtime.filmed import head_angles
from mien.training import TrainSettings
from mien.training.footage.frames import training_frames
from mien.training.run import read_face_track
from plain_settings import plain_mono_gaussian_avatar
from shared_things import MadeOnce, write_toy_workspace
from toy_scene import toy_camera, toy_face, toy_face_model, toy_sequence

pytestmark = pytest.mark.unchecked
_GROWTH = GradientSettings(start=0.2, stop=0.8, rounds=3, grow_gradient=1e-4, opacity_resets=(), max_gaussians=150)
CONFIG = HeadGasConfig(points=80, features=4, hidden=8, density=_GROWTH)
FILMS = {"basis.mp4": 32, "layers.mp4": 75, "beyond-expression.mp4": 60, "beyond-view.mp4": 60}
"""Frames of each film: 16 for each of the two expressions in the first one."""


@pytest.fixture
def toy(made_once: MadeOnce) -> Path:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(train_toy, "CONFIG", CONFIG)
        return made_once("analysis_headgas", write_toy_workspace)


@pytest.fixture(autouse=True)
def _small_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(headgas_ablations, "TIMED_SIDE", 16)
    for name, value in (("SIZES", {16: 4.0, 32: 8.0}), ("SIDE", 32)):
        monkeypatch.setattr(headgas, name, value)


workspace = pytest.fixture(lambda toy, tmp_path: Path(shutil.copytree(toy, tmp_path / "W")))


@pytest.fixture
def context(toy: Path, tmp_path: Path) -> Context:
    return Context(toy / "runs/toy", (toy / "sequences/clip",), torch.zeros(()), tmp_path, AnalysisOptions())


def analyze(method: str, root: Path, *more: str) -> dict[str, Any]:
    assert main(["analyze", method, str(root), *more]) == 0
    return json.loads((root / "analysis/toy/analysis.json").read_text())["parts"]


def test_parts_without_training_write_pictures_and_films(workspace: Path) -> None:
    before = tree_bytes(workspace)
    parts = analyze("headgas", workspace, "--seconds", "0.01")
    assert list(parts) == ["basis", "layers", "beyond", "sizes"]
    folder = workspace / "analysis/toy"
    assert {entry["file"] for part in parts.values() for entry in part["films"]} == set(FILMS)
    assert {name: count_frames(folder / name) for name in FILMS} == FILMS
    pictures = {entry["file"] for part in parts.values() for entry in part["pictures"]}
    assert {"basis.png", "layers-head.png", "layers-mouth.png", "beyond-view.png"} <= pictures
    assert all((folder / name).is_file() for name in ("beyond-change.svg", "sizes.svg"))
    assert all((folder / name).read_bytes().startswith(b"\x89PNG") for name in pictures)
    assert [row["name"] for row in parts["basis"]["values"]["rows"]] == ["drop", "swell"]
    assert not parts["basis"]["values"]["neutral_added"]
    assert parts["beyond"]["values"]["factors"][-1] == 1.4
    rows = parts["sizes"]["values"]["rows"]
    assert [(row["width"], row["height"], row["paper_ms"]) for row in rows] == [(16, 16, 4.0), (32, 32, 8.0)]
    assert all(row["frame_ms"] > 0 for row in rows)
    after = tree_bytes(workspace)
    assert {name: after[name] for name in before} == before


def test_several_subjects_are_joined_to_statistics(toy: Path, tmp_path: Path, capsys) -> None:
    folders = [str(shutil.copytree(toy, tmp_path / name)) for name in ("anna", "ben", "carl")]
    asked = ["--parts", "sizes", "layers", "--seconds", "0.01", "--out", str(tmp_path / "out")]
    assert main(["analyze", *folders, *asked, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["subjects"] == ["anna", "ben", "carl"]
    assert list(found["parts"]) == ["sizes"], "layers have no figures to join"
    records = [json.loads((tmp_path / "out" / name / "analysis.json").read_text()) for name in found["subjects"]]
    rows = {(row["row"], row["figure"]): row for row in found["parts"]["sizes"]}
    for index, size in enumerate(("16x16", "32x32")):
        own = [record["parts"]["sizes"]["values"]["rows"][index]["frame_ms"] for record in records]
        wanted = {"subjects": 3, "mean": pytest.approx(sum(own) / 3), "least": min(own), "largest": max(own)}
        assert rows[size, "frame_ms"] == {"row": size, "figure": "frame_ms", **wanted}
    assert "| 32x32 | Paper: frame, ms | 3 | 8 | 8 | 8 |" in (tmp_path / "out/joined.md").read_text()
    several = [{"values": {"rows": [{"name": "full", "head_psnr": psnr}]}} for psnr in (30.0, None, 31.0)]
    assert [(row["subjects"], row["mean"]) for row in joined_rows(several)] == [(2, 30.5)]


def test_the_ablations_are_trained_and_timed_alike(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    timed, measure = [], measuring.measure_drawing
    monkeypatch.setattr(measuring, "measure_drawing", lambda *args: timed.append(args[0].training) or measure(*args))
    asked = ("--parts", "ablations", "--steps", "6", "--seconds", "0.01")
    part = analyze("headgas", workspace, *asked)["ablations"]
    assert "ablations: 5 trainings of 6 steps each" in capsys.readouterr().err
    rows = part["values"]["rows"]
    assert [row["name"] for row in rows] == ["no_blending", "change_all", "delta", "no_mlp", "full"]
    assert all(row["gaussians"] > 0 and row["frame_ms"] > 0 and row["head_psnr"] > 0 for row in rows)
    assert len({row["head_psnr"] for row in rows}) == 5
    assert timed == [False] * 5, "as the avatars of finished trainings, which are baked"
    runs = sorted(path.name.rsplit("-", 2)[0] for path in (workspace / "analysis/toy/runs").iterdir() if path.is_dir())
    assert runs == [f"ablation-{name}" for name in ("change-all", "delta", "full", "no-blending", "no-mlp")]
    assert part["tables"][0]["rows"][-1][-3:] == [28_000, 4.0, 32.5]
    assert (workspace / "analysis/toy/ablations.png").is_file()
    assert analyze("headgas", workspace, *asked)["ablations"] == part
    assert list(analyze("headgas", workspace, *asked, "--widen")["ablations"]["values"]["widths"])[:2] == ["8", "16"]


def test_ablations_and_sizes_on_a_device(workspace: Path, elsewhere: set[str]) -> None:
    asked = ("--parts", "sizes", "ablations", "--steps", "2", "--seconds", "0.01", "--device", "auto")
    rows = analyze("headgas", workspace, *asked)["ablations"]["values"]["rows"]
    assert all(row["frame_ms"] > 0 and row["head_psnr"] > 0 for row in rows)
    assert "float64" in elsewhere


def test_rows_differ_only_in_what_they_say() -> None:
    plain = headgas_ablations.ablation_configs(CONFIG)
    assert "no_perceptual" not in plain
    free = replace(CONFIG, density=replace(_GROWTH, rules_off=("cap",)))
    assert (plain["full"], plain["delta"]) == (free, replace(free, variant="delta")), "without a limit of Gaussians"
    config = replace(CONFIG, variant="no_mlp", photometric=Photometric(perceptual=PerceptualLoss(weight=0.1)))
    rows = headgas_ablations.ablation_configs(config)
    assert list(rows) == list(headgas_ablations.ABLATIONS)
    without = rows["no_perceptual"]
    assert (without.variant, without.photometric.perceptual.weight) == ("full", 0.0)
    assert rows["full"] == replace(config, variant="full", density=free.density)
    rows = [{"name": name, "gaussians": n, "head_psnr": None} for name, n in (("delta", 40), ("full", 50))]
    (few,) = headgas_ablations.ablation_findings(10, rows)
    assert "with delta(mu, R) has the fewest Gaussians (40)" in few


def test_the_network_without_blending_widens_to_a_plateau(monkeypatch: pytest.MonkeyPatch) -> None:
    scores: dict[int, float | None] = {8: 20.0, 16: 20.5, 32: 20.55, 64: 30.0}
    monkeypatch.setattr(measuring, "held_out_scores", lambda width, metric: {"head_psnr": scores[width]})
    context: Any = SimpleNamespace(train=lambda name, config: config.hidden)
    first: Any = 8
    assert headgas_ablations.widened(context, CONFIG, first) == (16, {8: 20.0, 16: 20.5, 32: 20.55})
    scores[8] = None
    assert headgas_ablations.widened(context, CONFIG, first) == (8, {}), "nothing was held out"


def test_gaussians_are_removed_from_near_to_far() -> None:
    # The camera looks along -z. The third is faint, the fourth beside the picture, the fifth behind the camera.
    points = torch.tensor([[0.0, 0, -2], [0, 0.1, -1], [0, 0, -0.5], [9, 0, -1], [0, 0, 1], [0.1, 0, -3]])
    opacities = torch.tensor([1.0, 0.5, 0.001, 1.0, 1.0, 0.1])
    gaussians = Gaussians(points, torch.ones(6, 4), torch.ones(6, 3), opacities, torch.zeros(6, 1, 3))
    order = headgas.near_to_far(gaussians, toy_camera(64))
    assert order.tolist() == [1, 0, 5]
    assert headgas.without_nearest(6, order, 0.0).all()
    assert headgas.without_nearest(6, order, 0.67).tolist() == [False, False, True, True, True, True]


def test_the_mouth_is_that_of_a_frontal_frame_with_shut_lips(context: Context, monkeypatch) -> None:
    _, sequence = toy_sequence(20, 32)
    marks, turns = np.zeros((20, 1, 478, 2), np.float32), torch.zeros(20, 3)
    marks[:, 0, 263, 0], marks[:, 0, 14, 1], turns[3, 1] = 10.0, 4.0, 0.5
    assert headgas.shut_lips([replace(sequence, capture=replace(sequence.capture, landmarks=0 * marks))]) is None
    marks[[3, 7], 0, 14, 1], marks[9, 0, 13:15], marks[11, 0, 263] = 0.1, np.nan, 0.0
    changed = replace(sequence.tracking, face=replace(sequence.tracking.face, head_rotation=turns))
    found = replace(sequence, capture=replace(sequence.capture, landmarks=marks), tracking=changed)
    assert headgas.shut_lips([sequence, found]) == (1, 7), "of 3 and 7, it is the one that is not turned"
    (own,) = context.sequences
    vars(context)["sequences"] = [replace(own, capture=replace(own.capture, landmarks=marks[5:10]))]
    drawn, draw = [], measuring.draw_avatar
    monkeypatch.setattr(measuring, "draw_avatar", lambda *given: drawn.append(given[1]) or draw(*given))
    picture = headgas.layers(context).pictures[1]
    assert "The mouth in clip, timestep 2, whose lips are shut" in picture.caption
    wanted = read_face_track(context.run_dir, context.avatar.face_model)[2]
    assert torch.equal(drawn[-1].expression, wanted.expression)
    assert picture.image.shape[1] == 8 * 32 + 7 * 4, "the picture as it was filmed, then seven shares"


def test_bases_with_negative_coefficients_start_at_the_person_at_rest() -> None:
    model, face = toy_face_model(), toy_face(5)[1]
    start, added = start_of_bases(face, model)
    assert (added, bool(start.expression.any())) == (0, False)
    assert torch.equal(start.joints, face.joints)
    signed = replace(model, expression_bounds=torch.tensor([[-1.0, 1.0], [0.0, 1.0]]))
    assert start_of_bases(face, signed) == (face, 1)


def test_the_training_range_is_that_of_the_avatar(context: Context) -> None:
    filmed, model = trained_range(context), context.avatar.face_model
    assert context.avatar.filmed is not None
    assert torch.equal(filmed.highest, torch.from_numpy(context.avatar.filmed.highest[:2]))
    norms = model.expression_basis.flatten(1).norm(dim=-1)
    assert headgas.strongest_expression(context, filmed) == int((filmed.highest * norms).argmax())
    assert headgas.strongest_expression(context, replace(filmed, highest=torch.tensor([-1.0, 0.001]))) == 1
    face = context.avatar.subject
    assert with_expression(face, 1, 1.4).expression[0].tolist() == [float(face.expression[0, 0]), pytest.approx(1.4)]
    assert bool((busy_face(context).expression != face.expression).all())


def test_the_camera_goes_where_the_head_sees_it_at_an_angle(context: Context) -> None:
    trained, subject = trained_range(context), context.avatar.subject
    for yaw in (trained.yaws[0] - 0.5, 0.0, 0.6):
        eye = headgas.view_from(context, trained, yaw).position.numpy()
        seen = head_angles(subject.head_rotation.numpy(), subject.head_translation.numpy(), eye)
        assert seen[0, 0] == pytest.approx(yaw, abs=0.02)
    shown = [math.degrees(yaw) for yaw in headgas.shown_yaws(Trained(trained.highest, (-0.5, 0.25), 0.0))]
    low, high = math.degrees(-0.5), math.degrees(0.25)
    assert shown == pytest.approx([low - 30, low - 15, low, (low + high) / 2, high, high + 15, high + 30])
    # A view of the head holds it. A face model without regions of a mouth gives the whole head.
    model, face = toy_face_model(), toy_face(5)[0]
    camera = head_camera(model, face, toy_camera(64), 100)
    pixels, _ = camera.project(model(face)[0])
    assert 0 < float(pixels.min()) < float(pixels.max()) < 100
    assert mouth_camera(model, face, toy_camera(64), 50).K[0, 0] < 0.6 * camera.K[0, 0]


MONO = plain_mono_gaussian_avatar(points=60, max_points=120, epochs=10)


@pytest.fixture
def mono_toy(made_once: MadeOnce) -> Path:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(train_toy, "CONFIG", MONO)
        return made_once("analysis_mono", write_toy_workspace)


@pytest.fixture
def mono_workspace(mono_toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(mono_gaussian_avatar, "SIDE", 16)
    return Path(shutil.copytree(mono_toy, tmp_path / "W"))


def test_times_stand_beside_the_papers(mono_workspace: Path) -> None:
    part = analyze("mono-gaussian-avatar", mono_workspace, "--seconds", "0.01")
    assert list(part) == ["times"]
    times, rows = part["times"]["values"]["frame_ms"], part["times"]["tables"][0]["rows"]
    assert {name: value > 0 for name, value in times.items()} == {"networks": True, "baked": True}
    assert rows[-1][:3] == ["paper: MonoGaussianAvatar", 9.0, 30.0]
    assert rows[-4][:3] == ["paper: NeRFace", 48.0, 2000.0]


@pytest.mark.slow
def test_short_trainings_write_their_pictures(mono_workspace: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    # As in the paper: 0.0025 m from the middle between 512 and 1024 pixels on, which is at 724.
    assert [mono_gaussian_avatar.scale_gain(side) for side in (128, 512, 720, 730, 1024, 2048)] == 3 * [0.00625] + 3 * [
        0.0025
    ]
    monkeypatch.setattr(mono_gaussian_avatar, "GAINS", {16: 0.004, 32: 0.00625})
    asked = ("--parts", "convergence", "resolutions", "diversity", "--steps", "10")
    parts = analyze("mono-gaussian-avatar", mono_workspace, *asked)
    assert "diversity: 5 trainings of 10 steps each" in capsys.readouterr().err
    files = ("convergence.png", "convergence-psnr.svg", "convergence-points.svg", "resolutions.png", "diversity.png")
    assert all((mono_workspace / "analysis/toy" / name).is_file() for name in files)
    shown, sides, subsets = (parts[name]["values"]["rows"] for name in ("convergence", "resolutions", "diversity"))
    assert [row["step"] for row in shown] == [1, 2, 5, 10]
    assert [(row["side"], row["scale_gain"]) for row in sides] == [(32, 0.00625), (16, 0.004)]
    runs = (mono_workspace / "analysis/toy/runs").glob("resolution-*")
    gains = {one.name.split("-")[1]: load_avatar(one).config.scale_gain for one in runs}  # type: ignore[attr-defined]
    assert gains == {"16": 0.004, "32": 0.00625}
    clips = [("frontal clip", 1), ("mixed clip", 2)]
    wanted = [("all frames", 4), *clips, ("frontal quarter", 1), ("mixed half", 2)]
    assert [(row["name"], row["timesteps"]) for row in subsets] == wanted
    assert [len({row["head_psnr"] for row in rows}) for rows in (shown, sides)] == [4, 2]
    assert subsets[0]["head_psnr"] == sides[0]["head_psnr"], "all frames at full size is the same training in both"
    assert analyze("mono-gaussian-avatar", mono_workspace, *asked) == parts
    # A capture with more pixels than the paper's is trained at the paper's two sizes.
    monkeypatch.setattr(mono_gaussian_avatar, "GAINS", {16: 0.004, 24: 0.00625})
    shutil.rmtree(mono_workspace / "analysis")
    again = analyze("mono-gaussian-avatar", mono_workspace, "--parts", "resolutions", "--steps", "2")
    sides = again["resolutions"]["values"]["rows"]
    assert [(row["side"], row["scale_gain"]) for row in sides] == [(24, 0.00625), (16, 0.004)]


@pytest.mark.slow
def test_convergence_trains_as_the_run_did(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With steps before the first picture, as the presets `draft` and `standard` have them."""
    monkeypatch.setattr(train_toy, "CONFIG", plain_mono_gaussian_avatar(points=60, max_points=120, pretraining=7))
    write_toy_workspace(tmp_path / "W")
    seen: list[dict[str, torch.Tensor]] = []

    def drawn(avatar: Avatar, *_: Any) -> torch.Tensor:
        seen.append({name: tensor.clone() for name, tensor in avatar.state_dict().items()})
        return torch.full((32, 32, 3), 0.5)

    monkeypatch.setattr(mono_gaussian_avatar, "drawn", drawn)
    analyze("mono-gaussian-avatar", tmp_path / "W", "--parts", "convergence", "--steps", str(train_toy.SETTINGS.steps))
    trained = load_avatar(tmp_path / "W" / "runs" / "toy").state_dict()
    assert trained.keys() == seen[-1].keys()
    for name, tensor in trained.items():
        assert torch.equal(tensor, seen[-1][name]), name


def test_times_and_stages_on_a_device(mono_workspace: Path, elsewhere: set[str]) -> None:
    asked = ("--parts", "times", "convergence", "--steps", "2", "--seconds", "0.01", "--device", "auto")
    parts = analyze("mono-gaussian-avatar", mono_workspace, *asked)
    assert parts["convergence"]["values"]["rows"][-1]["head_psnr"] > 0
    assert "float64" in elsewhere


def measured(angles: np.ndarray, expressions: np.ndarray) -> mono_gaussian_avatar.Measured:
    return mono_gaussian_avatar.Measured(tuple((0, index) for index in range(len(angles))), angles, expressions)


def test_the_mixed_half_keeps_what_is_rare() -> None:
    angles, expressions = np.zeros((22, 2)), np.zeros((22, 3))
    angles[20, 0], expressions[21, 1] = 1.0, 4.0
    whole = measured(angles, expressions)
    chosen = mono_gaussian_avatar.mixed_half(whole)
    assert len(chosen) == len(set(chosen)) == 11
    assert {20, 21} <= set(chosen)
    assert (
        mono_gaussian_avatar.ranges(whole, chosen)["yaw_range"]
        > mono_gaussian_avatar.ranges(whole, list(range(20)))["yaw_range"]
        == 0
    )
    # Subsets are chosen among the frames of the training.
    _, sequence = toy_sequence(10, 32)
    frames = training_frames([sequence], TrainSettings(split="tail"))
    found = mono_gaussian_avatar.measure([sequence], frames)
    assert found.timesteps == tuple((0, index) for index in range(8))
    assert found.expressions.std(0)[sequence.tracking.face.expression[:8].std(0).numpy() > 0] == pytest.approx(1)
    (mask,) = mono_gaussian_avatar.masks([sequence], found, [0, 3])
    assert mask.nonzero()[:, 0].tolist() == [0, 3]
    assert mono_gaussian_avatar.ranges(found, list(range(8)))["expression_spread"] == pytest.approx(1)


def test_the_frontal_quarter_has_the_views_nearest_to_the_median():
    yaws = np.array([-0.9, 0.05, 0.8, 0.0, -0.05, 0.7, -0.8, 0.02])
    whole = measured(np.stack([yaws, 0 * yaws], 1), np.zeros((8, 1)))
    assert mono_gaussian_avatar.frontal_quarter(whole) == [3, 7]
    # Clips are successive timesteps: the two that are nearest to the front, and the four with the most varied views.
    assert mono_gaussian_avatar.clip(whole, 0.25, mixed=False) == [3, 4]
    assert mono_gaussian_avatar.clip(whole, 0.5, mixed=True) == [0, 1, 2, 3]
    # Clips are successive timesteps, whatever lies between the best ones.
    assert mono_gaussian_avatar.clip(whole, 0.25, mixed=False) == [3, 4]
    assert mono_gaussian_avatar.clip(whole, 0.5, mixed=True) == [0, 1, 2, 3]
    assert mono_gaussian_avatar.clip(whole, 0.25, mixed=True) == [5, 6]
