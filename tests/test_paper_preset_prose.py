"""The code does what docs/paper_preset.md says outside of its tables, and the log has its figures."""

import math
import re
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch

from mien.avatar import METHODS, GaussianAvatars, MonoGaussianAvatar, PointAvatarConfig, Progress, Rate
from mien.avatar.mono_gaussian_avatar.networks import ATTRIBUTES
from mien.avatar.mono_gaussian_avatar.schedule import Schedule
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.cli import main
from mien.commands.stages import training
from mien.face import FaceModel
from mien.training import PRESETS, TrainSettings
from mien.training.adam import Adam
from mien.training.density_control import density_strategy
from mien.training.density_control.gradient import round_steps
from mien.training.face_track import FaceTrack
from mien.training.footage.constants import FOOTAGE
from paper_preset_page import DOCS, PAGE, flat, rows_of
from plain_settings import plain_mono_gaussian_avatar
from test_density import ABOVE, control, make_store, pose, random, rendering
from test_paper_preset import PAPER, STEPS, moved_per_visit, resets, rounds
from toy_scene import toy_face, toy_face_model

TEXT = flat(PAGE.read_text())
LOG = flat((DOCS / "log.md").read_text())
OF_A_PAPER = [name for name in METHODS if "paper" in METHODS[name].presets]


def says(*sentences: str) -> None:
    """Assert that the page has these words."""
    for sentence in sentences:
        assert sentence in TEXT, f"docs/paper_preset.md does not say: {sentence}"


def logged(*words: str) -> None:
    """Assert that the log has these words."""
    for some in words:
        assert some in LOG, f"docs/log.md does not say: {some}"


# -- the preset -------------------------------------------------------------------------------------------------------


def values(settings: Any, place: str = "") -> dict[str, Any]:
    """All settings by their dotted names. A learning rate is one of them."""
    found = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        inside = is_dataclass(value) and not isinstance(value, Rate)
        found |= values(value, f"{place}{field.name}.") if inside else {place + field.name: value}
    return found


def written(name: str) -> set[str]:
    """The ways to write a setting in the first column of a table."""
    parts = name.split(".")
    return {".".join(parts[:end]) for end in range(1, len(parts) + 1)} | {parts[-1]}


@pytest.mark.parametrize(
    ("method", "section"),
    [("gaussian_avatars", "GaussianAvatars"), ("headgas", "HeadGaS"),
     ("mono_gaussian_avatar", "MonoGaussianAvatar"), ("point_avatar", "PointAvatar")],
)  # fmt: skip
def test_what_no_table_lists_is_as_in_standard(method: str, section: str) -> None:
    says("It is a list of differences to the defaults, which are the preset `standard`",
         "Settings that this page does not list are as in `standard`.")  # fmt: skip
    assert PRESETS["standard"].config(method) == METHODS[method].config()
    named = {name for names, (_, _, why) in rows_of(section).items() for name in names.split(", ") + why.split("`")}
    standard, paper = values(METHODS[method].config()), values(PRESETS["paper"].config(method))
    assert [name for name in paper if paper[name] != standard[name] and not written(name) & named] == []


def test_defaults_that_the_page_names() -> None:
    gaussian_avatars: Any = METHODS["gaussian_avatars"].config()
    headgas: Any = METHODS["headgas"].config()
    assert gaussian_avatars.appearance == "features"
    assert headgas.sh_degree == 0
    says("The defaults give sizes in metres (`density.size_unit metres`) and do not multiply the rate.")
    for config in (gaussian_avatars, headgas):
        assert (config.density.size_unit, config.means_times_extent) == ("metres", False)


def test_the_run_of_every_method_has_the_settings_of_the_first_table() -> None:
    says("All methods have it but `textured_mesh`", "For every method, the run therefore has these settings, and all "
         "others of a run but `steps` are the defaults")  # fmt: skip
    assert set(METHODS) - set(OF_A_PAPER) == {"textured_mesh"}
    table = dict(re.findall(r"^\| `([a-z]+)` \| [a-z]+ \| ([a-z]+) \|$", PAGE.read_text(), flags=re.MULTILINE))
    assert sorted(table) == ["background", "edges", "inside", "mesh", "unseen"]
    for method in OF_A_PAPER:
        settings = PRESETS["paper"].settings_of(method)
        assert settings == replace(TrainSettings(), steps=settings.steps, **table)


def test_what_is_held_out_is_no_part_of_the_preset() -> None:
    says("The frames that the paper holds out are not part of the preset: `--split gaussian-avatars`")
    assert {PRESETS["paper"].settings_of(method).split for method in OF_A_PAPER} == {TrainSettings().split}


def test_commands_of_the_page_give_what_they_are_for(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each example is parsed as a user types it."""
    for name in ("capture/capture.json", "tracking/tracking.json"):
        (tmp_path / "sequences" / "clip" / name).parent.mkdir(parents=True)
        (tmp_path / "sequences" / "clip" / name).touch()
    asked: list[tuple[Any, Any]] = []
    monkeypatch.setattr(training, "run_training_stage", lambda *given, **_: asked.append((given[3], given[4])))
    commands = re.findall(r"^    mien train \S+ ([^#\n]*)", PAGE.read_text(), flags=re.MULTILINE)
    for line in commands:
        words = line.replace("--split gaussian-avatars", "").split()
        assert main(["train", str(tmp_path), *words]) == 0, line
    (whole, whole_run), (_, short_run), (lower, _), (without, _), (small, small_run) = asked
    assert (whole, whole_run) == (PAPER, PRESETS["paper"].settings_of("gaussian_avatars"))
    assert short_run.steps == 3_000
    assert lower.face_tuning == replace(PAPER.face_tuning, expression=Rate(1e-3)), "the paper's own rate"
    assert without.photometric.perceptual.weight == 0
    assert small == PRESETS["paper-cpu"].config("mono_gaussian_avatar")
    assert small_run == PRESETS["paper-cpu"].settings_of("mono_gaussian_avatar")


# -- schedules --------------------------------------------------------------------------------------------------------


def test_the_page_has_the_schedule_of_a_short_run() -> None:
    (first, second, *_), (reset, next_reset, *_) = rounds(3_000), resets(3_000)
    says(f"for GaussianAvatars, it has rounds of density control every {second - first} steps from step {first}, and "
         f"opacity resets at step {reset} and every {next_reset}.")  # fmt: skip
    assert {step / 3_000 for step in rounds(3_000)} == {step / STEPS for step in rounds(STEPS)}


def test_no_round_or_reset_is_after_the_last_step() -> None:
    for method in ("gaussian_avatars", "headgas"):
        config: Any = PRESETS["paper"].config(method)
        steps, density = PRESETS["paper"].settings_of(method).steps, config.density
        assert max(round_steps(density.start, density.stop, density.rounds, steps)) < steps
        assert max(density.opacity_resets, default=0) < 1
    assert PAPER.density.reset_opacity == 0.01


def test_rates_of_expressions_count_only_with_a_rank() -> None:
    for rank, names in ((0, []), (2, ["color_basis", "opacity_basis"])):
        config = replace(
            PAPER, expression_rank=rank, expression_color_rate=Rate(0.1), expression_opacity_rate=Rate(0.1)
        )
        avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
        assert sorted(group.name for group in avatar.parameter_groups() if group.rate == Rate(0.1)) == names


def test_epochs_and_units_of_mono_gaussian_avatar() -> None:
    paper: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    frames = PRESETS["paper"].settings_of("mono_gaussian_avatar").steps // paper.epochs
    says(f"the preset takes {paper.epochs} epochs of {frames:,} frames, a video of {frames // 25} seconds at 25 frames "
         "a second.", "which is four times life size, divided by 4.",
         f"fewer beyond {paper.points_per_step // paper.frames_per_step:,} points")  # fmt: skip
    assert LENGTH_UNIT == 1 / 4


def test_lengths_of_late_children() -> None:
    late = Schedule("paper", 120, 400, late_epoch=101).sampling_length(101 / 120)
    assert late == Schedule("code", 120, 400, late_epoch=101).sampling_length(101 / 120)
    says(f"Both use {late} m ({late / LENGTH_UNIT:.0e} in the paper's lengths) after epoch 100.".replace("e-0", "e-"))


def test_point_avatar_has_the_successors_sizes() -> None:
    own: Any = PRESETS["paper"].config("point_avatar")
    successor: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    sizes = (own.surface_width, own.surface_layers, own.encoding_bands, own.deformation_width)
    assert sizes == (
        successor.attribute_width, successor.attribute_layers, successor.encoding_bands, successor.deformation_width
    )  # fmt: skip
    assert isinstance(own, PointAvatarConfig)
    assert 2 * own.closing + 1 == 3, "erosion and dilation by 3x3 pixels"


def test_no_run_of_point_avatars_preset_is_among_ours() -> None:
    says("No run of this preset is among [ours](papers.md).")
    for page in ("papers.md", "results.md"):
        rows = [line for line in (DOCS / page).read_text().splitlines() if "point_avatar" in line]
        assert rows
        assert not [line for line in rows if re.search(r"point_avatar[^|]*--preset paper", line)]


# -- what no setting says and yet differs -----------------------------------------------------------------------------


@pytest.fixture
def mono() -> MonoGaussianAvatar:
    """An avatar whose networks change attributes with motion."""
    torch.manual_seed(0)
    config = plain_mono_gaussian_avatar(points=40, max_points=60, own_rate=Rate(0.0))
    avatar = MonoGaussianAvatar(config, toy_face_model(), toy_face(5))
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return avatar


@pytest.mark.parametrize(("attribute", "drawn"), zip(ATTRIBUTES, ("scales", "quats", "opacities", "sh"), strict=True))
def test_each_head_predicts_its_own_attribute(attribute: str, drawn: str, mono: MonoGaussianAvatar) -> None:
    """In the published code, columns of scales and rotations are mixed up."""
    face, index = toy_face(5)[2], ATTRIBUTES.index(attribute)
    before = mono.pose(face, Progress(0, 100)).gaussians
    with torch.no_grad():
        layer: Any = mono.attributes.outputs[index]
        bias = layer.bias
        bias.add_(torch.linspace(0.5, 1, len(bias)))
    after = mono.pose(face, Progress(0, 100)).gaussians
    names = ("quats", "scales", "opacities", "sh")
    assert [name for name in names if not torch.equal(getattr(before, name), getattr(after, name))] == [drawn]


def test_a_turn_of_the_head_alone_changes_no_attribute_of_the_heads_own_points(mono: MonoGaussianAvatar) -> None:
    """In the published code, attributes change with the motion in the world."""
    with torch.no_grad():
        mono.deformation.skinning.bias[-1] = -1e3  # no point hangs on the bone that stands still
    face = toy_face(5)[2]
    turned = replace(face, head_rotation=face.head_rotation + 0.5)
    posed = [mono.pose(one, Progress(0, 100)).gaussians for one in (face, turned, toy_face(5)[0])]
    for name in ("scales", "quats", "opacities", "sh"):
        here, there, other = (getattr(one, name) for one in posed)
        torch.testing.assert_close(there, here, atol=1e-5, rtol=0)
        assert not torch.allclose(other, here, atol=1e-6), "an expression changes them"


def test_moments_of_points_and_networks_outlive_a_round(mono: MonoGaussianAvatar) -> None:
    """In the published code, each round makes a new optimiser, without moments."""
    adam: Adam = Adam()
    network: Any = mono.attributes.outputs[0]

    def step(gradient: float, number: int) -> None:
        for parameter in mono.parameters():
            parameter.grad = torch.full_like(parameter, gradient)
        adam.step(mono.parameter_groups(), Progress(number, 100))

    step(1.0, 0)
    strategy = density_strategy(mono.density(), mono.store)
    posed = mono.pose(toy_face(5)[0], Progress(0, 100))
    strategy.observe(posed, rendering([0.0] * len(mono.store)))
    assert strategy.adapt(mono.store, posed, Progress(0, 100), random)
    moments: Any = mono.store.moments["means"]
    assert (moments.step, len(moments.first)) == (1, len(mono.store))
    assert (moments.first != 0).any()
    before = network.bias.detach().clone()
    step(0.0, 1)
    assert (network.bias.detach() != before).all(), "momentum goes on without a gradient"


# -- figures that were measured ---------------------------------------------------------------------------------------


def test_figures_of_wide_gaussians_are_those_of_the_log() -> None:
    pattern = r"^\| (\w+) \| ([\d,]+) \| ([\d.]+), ([\d.]+) dB; ([\d,]+) Gaussians \| ([\d.]+), ([\d.]+) dB; ([\d,]+) G"
    rows = re.findall(pattern, PAGE.read_text(), flags=re.MULTILINE)
    assert [row[:2] for row in rows] == [("wojtek", "3,000"), ("d18", "6,000")]
    (clip, steps, *first), (other, more_steps, *second) = rows
    logged(
        "{} steps: with it {}, head {} ({} Gaussians), without {}, {} ({});".format(f"{clip}, {steps}", *first),
        "{} steps: {}, {} ({}) and {}, {} ({}).".format(f"{other}, {more_steps}", *second),
        "Foreheads get holes. *Not kept:* `paper` does as the code.",
    )
    gaps = [rounds(int(number.replace(",", ""))) for number in (steps, more_steps)]
    says("a round every {} or {} steps instead of every 2,000".format(*(steps[1] - steps[0] for steps in gaps)),
         "With the rule, foreheads get holes.", "removes Gaussians with a radius of more than 20 pixels on screen",
         "Neither was run at full length.")  # fmt: skip


def test_figures_of_rates_in_units_of_flame_are_those_of_the_log(anny: FaceModel) -> None:
    logged("`paper` in 1,500 steps:** 15.26 / 21.20, with standard's face rates 16.47 / 21.52.")
    says("A run of 1,500 steps with these rates got 15.26 dB, and one with the rates of `standard` 16.47",
         "Coefficients of `anny` go from 0 to 1.5 at most.")  # fmt: skip
    assert (anny.expression_bounds.min(), anny.expression_bounds.max()) == (0, 1.5)


def test_times_of_headgas_are_those_of_the_log() -> None:
    logged("**HeadGaS' perceptual loss** on the person's box takes 2.4 s a step on one busy core.",
           "wojtek at 24,600 to 29,000 Gaussians, one thread beside other work: 0.71 -> 0.25 s a step.")  # fmt: skip
    paper: Any = PRESETS["paper"].config("headgas")
    steps = PRESETS["paper"].settings_of("headgas").steps
    having = sum(paper.photometric.perceptual.due(step, steps) for step in range(steps))
    says(f"took 2.4 s a step on one busy core ([log](log.md#training)). At that, the {having:,} steps that have it "
         f"take {having * 2.4 / 3600:.0f} hours. Without it, a step took 0.25 s with 24,600 to 29,000 Gaussians, and "
         f"the whole run would take {steps * 0.25 / 3600:.1f} hours.")  # fmt: skip


# -- the extent -------------------------------------------------------------------------------------------------------


def test_the_page_has_the_numbers_of_the_extent() -> None:
    """The cameras themselves are in `test_extent_is_that_of_the_training_cameras`."""
    least = FOOTAGE.least_extent
    says(f"E is {FOOTAGE.extent_margin} times the largest distance of a training camera from the mean",
         f"**E is at least {least} m.** One fixed camera has an E of 0",
         f"Gaussians over {1e3 * least * PAPER.density.split_size:g} mm are split and those over "
         f"{1e2 * least * PAPER.density.prune_size:g} cm are removed.",
         "Sixteen cameras one metre around the front of a head, up to 45 degrees to both sides, have an E of about 0.8",
         "Two cameras side by side get the same floor.")  # fmt: skip


def test_with_an_extent_of_0_nothing_moves_all_is_split_and_all_is_too_large() -> None:
    """The floor of E serves a single camera, and two that stand side by side."""
    says("centres would never move, every Gaussian that grows would be split, and from step 60,000 on every Gaussian "
         "would be too large.")  # fmt: skip
    avatar = GaussianAvatars(PAPER, toy_face_model(), toy_face(5))
    (means,) = [group for group in avatar.parameter_groups() if group.name == "means"]
    sizes = [1e-6, 0.0049, 0.0051, 0.06]
    expected = {  # faces of what is left, before and after step 60,000
        0.0: ([0, 0, 1, 1, 2, 2, 3, 3], [0, 0]),  # the last one stays, and is split
        FOOTAGE.least_extent: ([0, 0, 1, 1, 2, 2, 3, 3], [0, 0, 1, 1, 2, 2]),
    }
    for extent, (early, late) in expected.items():
        assert means.rate_at(Progress(0, STEPS, extent=extent)) == pytest.approx(5e-3 * extent)
        for step, faces in ((59_999, early), (61_999, late)):
            store = make_store(sizes)
            strategy = control(store, PAPER.density)
            strategy.observe(pose(store), rendering([ABOVE * 2] * len(sizes)))
            strategy.adapt(store, pose(store), Progress(step, STEPS, extent=extent), random)
            assert sorted(store["face_index"].tolist()) == faces, (extent, step)
            if step == 59_999:
                split = store["log_scales"].detach().exp()[:, 0] < 0.7 * torch.tensor(sizes)[store["face_index"]]
                cut = set(store["face_index"][split].tolist())
                assert cut == ({0, 1, 2, 3} if extent == 0 else {2, 3}), extent


# -- rates of the face ------------------------------------------------------------------------------------------------


def test_the_page_has_the_factors_of_a_dense_adam() -> None:
    factors = [round(moved_per_visit(frames, 1)) for frames in (250, 1_000, 2_000)]
    says("Adam's recursion gives {} for 250 frames, {} for 1,000 and {} for 2,000".format(*factors),
         f"the factor ends below 1 / sqrt(1 - 0.999) = {1 / math.sqrt(1 - 0.999):.0f}.",
         f"This preset multiplies the paper's rates by {factors[-1]}, the factor for 2,000 frames.")  # fmt: skip
    for name, published in (
        ("expression", 1e-3),
        ("joints", 1e-5),
        ("head_rotation", 1e-5),
        ("head_translation", 1e-6),
    ):
        assert getattr(PAPER.face_tuning, name).start == pytest.approx(factors[-1] * published)
    assert all(moved_per_visit(frames, 1) < 32 for frames in (1_000, 2_000, 8_000))


def test_a_dense_adam_moves_a_frame_by_the_root_of_the_number_of_frames() -> None:
    says("the first moments of a visit add up to g, and the root of the second moment is g / sqrt(T). "
         "The frame moves by sqrt(T) times the rate.")  # fmt: skip
    assert sum(0.1 * 0.9**step for step in range(1_000)) == pytest.approx(1)
    second = 0.0
    for step in range(100_000):
        second = 0.999 * second + 0.001 * (step % 50 == 0)
    assert math.sqrt(second) == pytest.approx(1 / math.sqrt(50), rel=0.03)
    for frames in (30, 60, 100):
        assert moved_per_visit(frames, 1) == pytest.approx(math.sqrt(frames), rel=0.05)


def test_each_frame_has_moments_and_a_step_count_of_its_own() -> None:
    says("mien's Adam has moments and a step count for each frame, and a step moves only its own frame, by about the "
         "learning rate.")  # fmt: skip
    start, adam = toy_face(6), Adam()
    track = FaceTrack(start, replace(PAPER.face_tuning, expression=Rate(0.01)))
    for step, frame in enumerate((2, 2, 4)):
        track.face(frame).expression.sum().backward()
        adam.step(track.parameter_groups(frame), Progress(step, 10))
    counts = {
        name: tensor for name, tensor in track.state().items() if name.startswith("expression") and "step" in name
    }
    (count,) = counts.values()
    assert count.tolist() == [0, 0, 2, 0, 1, 0]
    moved = start.expression - torch.stack([track.face(index).expression[0].detach() for index in range(6)])
    torch.testing.assert_close(moved[:, 0], 0.01 * count)
