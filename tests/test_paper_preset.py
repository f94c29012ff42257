"""The preset `paper` of GaussianAvatars has the numbers of the paper, its supplement and its published code."""

import math
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mien.avatar import METHODS, GaussianAvatars, Progress, Rate
from mien.camera import Camera
from mien.training import PRESETS, TrainSettings, train
from mien.training.adam import Adam
from mien.training.density_control.gradient import round_steps
from mien.training.footage.constants import FOOTAGE
from mien.training.footage.frames import Frame, camera_extent
from paper_preset_page import PAGE, values_of
from plain_settings import plain_gaussian_avatars, plain_run
from toy_scene import toy_face, toy_face_model, toy_sequence

PAPER: Any = PRESETS["paper"].config("gaussian_avatars")
STEPS = 600_000


def resets(steps: int) -> list[int]:
    return [round(time * steps) for time in PAPER.density.opacity_resets]


def rounds(steps: int) -> list[int]:
    density = PAPER.density
    return sorted(round_steps(density.start, density.stop, density.rounds, steps))


def test_schedule() -> None:
    assert PRESETS["paper"].settings_of("gaussian_avatars") == plain_run(steps=STEPS)
    assert rounds(STEPS) == list(range(12_000, 600_000, 2_000))
    assert resets(STEPS) == [10_000, *range(60_000, 600_000, 60_000)]
    assert PAPER.density.reset_opacity == 0.01


def test_a_shorter_run_has_the_same_schedule() -> None:
    assert rounds(3_000) == list(range(60, 3_000, 10))
    assert resets(3_000) == [50, *range(300, 3_000, 300)]


def test_density_control() -> None:
    density = PAPER.density
    assert density.grow_gradient == 2e-4
    assert (density.size_unit, density.split_size, density.prune_size) == ("extent", 0.01, 0.1)
    assert density.prune_opacity == 0.005
    assert (density.prune_radius, density.rules.prune_wide) == (20, False), "the code never prunes by the radius"
    assert density.max_gaussians >= 200_000


def test_colors_gain_a_degree_every_thousand_steps() -> None:
    avatar = GaussianAvatars(PAPER, toy_face_model(), toy_face(5))
    steps = (0, 999, 1_000, 1_999, 2_000, 2_999, 3_000, 599_999)
    counts = [avatar.pose(toy_face(5)[0], Progress(step, STEPS)).gaussians.sh.shape[-2] for step in steps]
    assert counts == [1, 1, 4, 4, 9, 9, 16, 16]
    assert PAPER.sh_frame == "world"


def test_rates_and_losses() -> None:
    avatar = GaussianAvatars(PAPER, toy_face_model(), toy_face(5))
    groups = {group.name: group for group in avatar.parameter_groups()}
    first, last = Progress(0, STEPS, extent=2.0), Progress(STEPS, STEPS, extent=2.0)
    assert (groups["means"].rate_at(first), groups["means"].rate_at(last)) == pytest.approx((2 * 5e-3, 2 * 5e-5))
    expected = {
        "sh_constant": 2.5e-3,
        "sh_rest": 2.5e-3 / 20,
        "opacity_logits": 0.05,
        "log_scales": 0.017,
        "quats": 1e-3,
    }
    for name, rate in expected.items():
        assert groups[name].rate_at(first) == groups[name].rate_at(last) == pytest.approx(rate), name
    photometric = PAPER.photometric
    assert (photometric.l1_weight, photometric.ssim_weight, photometric.alpha_weight) == (0.8, 0.2, 0)
    assert (PAPER.position_weight, PAPER.position_threshold) == (0.01, 1)
    assert (PAPER.scale_weight, PAPER.scale_threshold) == (1, 0.6)


def moved_per_visit(frames: int, rate: float) -> float:
    """How far a dense Adam moves a value between two visits of its frame, whose gradient is always 1 then."""
    first = second = moved = 0.0
    visits = max(4, 8_000 // frames)
    for step in range(visits * frames):
        gradient = 1.0 if step % frames == 0 else 0.0
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        if step >= (visits - 1) * frames:
            moved += rate * (first / (1 - 0.9 ** (step + 1))) / math.sqrt(second / (1 - 0.999 ** (step + 1)))
    return moved


def test_face_rates_do_per_visit_what_the_papers_dense_optimiser_does() -> None:
    tuning = PAPER.face_tuning
    papers = {"head_rotation": 1e-5, "joints": 1e-5, "head_translation": 1e-6, "expression": 1e-3}
    assert tuning.enabled
    for name, rate in papers.items():
        ours = getattr(tuning, name)
        assert ours.end is None
        assert ours.start == pytest.approx(moved_per_visit(2_000, rate), rel=0.1)
    # The factors that docs/paper_preset.md names.
    assert [round(moved_per_visit(frames, 1)) for frames in (250, 1_000, 2_000)] == [15, 25, 30]


def names_in(changes: dict[str, Any], place: str = "") -> list[str]:
    """The dotted names of all settings that a preset changes. A learning rate is one of them."""
    rate = {field.name for field in fields(Rate)}
    groups = {name: value for name, value in changes.items() if isinstance(value, dict) and not rate >= value.keys()}
    inside = [one for name, value in groups.items() for one in names_in(value, f"{place}{name}.")]
    return inside + [place + name for name in changes if name not in groups]


@pytest.mark.parametrize(
    ("method", "section"),
    [
        ("gaussian_avatars", "GaussianAvatars"),
        ("headgas", "HeadGaS"),
        ("mono_gaussian_avatar", "MonoGaussianAvatar"),
        ("point_avatar", "PointAvatar"),
    ],
)
def test_docs_name_every_setting_that_differs_from_the_default(method: str, section: str) -> None:
    rows = re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)
    (own,) = [text for text in rows if text.startswith(f"{section}\n")]
    named = set(re.findall(r"`([a-z_.]+)`", "\n".join(line for line in own.splitlines() if line.startswith("| "))))
    paper = METHODS[method].presets["paper"]
    assert "method" in paper
    for setting in names_in(paper["method"]):
        parts = setting.split(".")
        written = {".".join(parts[:end]) for end in range(1, len(parts) + 1)} | {parts[-1]}
        assert named & written, setting


def test_docs_have_values_that_differ_from_the_default() -> None:
    page = PAGE.read_text()
    own = page[: page.index("## HeadGaS")]
    table = dict(re.findall(r"^\| `([a-z_.]+)` \|(.*)\|$", own, flags=re.MULTILINE))
    for name, words in (("density.max_gaussians", "200,000"), ("density.rounds", "294"), ("density.split_size", ".01")):
        assert words in table[name]
    default = TrainSettings()
    assert PRESETS["paper"].changes
    for name, value in PRESETS["paper"].changes.items():
        assert table[name].split(" | ") == [f" {getattr(default, name)}", f"{value} "], name


def test_every_method_of_a_paper_has_the_preset() -> None:
    without = [name for name, method in METHODS.items() if "paper" not in method.presets]
    assert without == ["textured_mesh"], "which repeats no paper"


def test_docs_have_all_values_of_gaussian_avatars() -> None:
    density, tuning = PAPER.density, PAPER.face_tuning
    all_rounds, all_resets = rounds(STEPS), resets(STEPS)
    judged_from = min(step for step in all_resets if step > all_rounds[0])

    def number(value: float) -> str:
        return f"{value:g}".replace("0.", ".")

    def power(rate: Rate) -> str:
        assert rate.end is None
        return f"{rate.start:.0e}".replace("e-0", "e-")

    assert (PAPER.means_rate, PAPER.sh_degree, PAPER.sh_warmup) == (Rate(5e-3, 5e-5), 3, 4 / 600)
    assert (PAPER.means_times_extent, density.size_unit) == (True, "extent")
    assert density.size_start is None, "sizes are judged from the first reset after the first round"
    assert (tuning.keep_mean_pose, tuning.keep_turns) == (False, False)
    expected = {
        "steps": f"{STEPS:,}",
        "sh_degree": f"{PAPER.sh_degree}",
        "sh_warmup": "1/150 of the run: degrees 1, 2, 3 from steps 1,000, 2,000, 3,000",
        "means_rate": "5e-3 to 5e-5, log-linear",
        "means_times_extent": "rate times E",
        "density.start": f"step {all_rounds[0]:,}",
        "density.rounds": f"{len(all_rounds)} rounds, one every {all_rounds[1] - all_rounds[0]:,} steps",
        "density.stop": f"step {all_rounds[-1]:,}",
        "density.grow_gradient": f"{density.grow_gradient:.0e}".replace("e-0", "e-"),
        "density.size_unit": "extent",
        "density.split_size": f"{number(density.split_size)} E",
        "density.prune_size": f"{number(density.prune_size)} E, from step {judged_from:,}",
        "density.prune_radius, density.rules.prune_wide": f"{density.prune_radius:g} pixels, "
        + ("yes" if density.rules.prune_wide else "no"),
        "density.prune_opacity": number(density.prune_opacity),
        "density.opacity_resets": f"the same, to step {all_resets[-1]:,}",
        "density.max_gaussians": f"{density.max_gaussians:,}",
        "photometric": "the same",
        "expression_rank": f"{PAPER.expression_rank}",
        "appearance": PAPER.appearance,
        "position_weight, position_threshold": f"{number(PAPER.position_weight)}, {PAPER.position_threshold:g}",
        "scale_weight, scale_threshold": f"{PAPER.scale_weight:g}, {number(PAPER.scale_threshold)}",
        "face_tuning.expression": power(tuning.expression),
        "face_tuning.joints": power(tuning.joints),
        "face_tuning.head_rotation": power(tuning.head_rotation),
        "face_tuning.head_translation": power(tuning.head_translation),
        "face_tuning.keep_mean_pose, face_tuning.keep_turns": "no",
    }
    assert values_of("GaussianAvatars") == expected


# -- the extent of the cameras ----------------------------------------------------------------------------------------


def camera_at(*center: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor(center)
    return Camera(torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), viewmat, 16, 16)


def test_extent_is_that_of_the_training_cameras() -> None:
    _, sequence = toy_sequence(2, 16)
    cameras = (camera_at(0, 0, 0), camera_at(4, 0, 0), camera_at(2, 30, 0))
    rig = replace(sequence, tracking=replace(sequence.tracking, cameras=cameras))
    assert camera_extent([rig], [Frame(0, 0, 0), Frame(0, 1, 0), Frame(0, 0, 1)]) == pytest.approx(1.1 * 2)
    assert camera_extent([rig], [Frame(0, 0, 0)]) == FOOTAGE.least_extent == 0.5
    angles = torch.linspace(-math.pi / 4, math.pi / 4, 16).tolist()
    ring = tuple(camera_at(math.sin(angle), 0, math.cos(angle)) for angle in angles)
    arc = replace(sequence, tracking=replace(sequence.tracking, cameras=ring))
    assert camera_extent([arc], [Frame(0, 0, index) for index in range(16)]) == pytest.approx(0.8, abs=0.02)
    assert (PAPER.density.split_size, PAPER.density.prune_size) == (0.005 / FOOTAGE.least_extent, 0.05 / 0.5)
    near = replace(sequence, tracking=replace(sequence.tracking, cameras=(camera_at(0, 0, 0), camera_at(0.1, 0, 0))))
    assert camera_extent([near], [Frame(0, 0, 0), Frame(0, 0, 1)]) == FOOTAGE.least_extent


def test_extent_reaches_rates_in_its_unit_only() -> None:
    for config, factor in ((plain_gaussian_avatars(), 1), (plain_gaussian_avatars(means_times_extent=True), 3)):
        moved = []
        for extent in (1.0, 3.0):
            torch.manual_seed(0)
            avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
            store = avatar.gaussian_store()
            (store["means"].sum() + store["log_scales"].sum()).backward()
            Adam().step(avatar.parameter_groups(), Progress(0, 10, extent=extent))
            moved.append((float(store["means"].detach().abs().max()), float(store["log_scales"].detach().abs().max())))
        assert moved[1][0] == pytest.approx(factor * moved[0][0])
        assert moved[1][1] == moved[0][1]


def test_a_stopped_run_of_the_preset_ends_as_if_it_had_not_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mien.training.trainer.camera_extent", lambda *_: 1.7)
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    settings = plain_run(steps=60, checkpoint_every=20, split="none")
    whole = train([sequence], face_model, PAPER, settings, tmp_path / "whole")
    train([sequence], face_model, PAPER, settings, tmp_path / "stopped")
    for file in (*(tmp_path / "stopped" / "checkpoints").glob("*60.safetensors"), tmp_path / "stopped/training.json"):
        file.unlink()
    again = train([sequence], face_model, PAPER, settings, tmp_path / "stopped")
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name]), name
