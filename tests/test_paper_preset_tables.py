"""docs/paper_preset.md and the presets `paper` of HeadGaS, MonoGaussianAvatar and PointAvatar say the same."""

import re
from dataclasses import replace
from typing import Any

import pytest

from mien.avatar import METHODS, Rate
from mien.avatar.mono_gaussian_avatar.schedule import Schedule, ScheduleName
from mien.training import PRESETS
from mien.training.density_control.gradient import round_steps
from paper_preset_page import PAGE, values_of

# -- HeadGaS -----------------------------------------------------------------------------------------------------------


def steps_of(steps: int, *times: float) -> list[int]:
    return [round(time * steps) for time in times]


def test_docs_have_all_values_of_headgas() -> None:
    paper: Any = PRESETS["paper"].config("headgas")
    steps = PRESETS["paper"].settings_of("headgas").steps
    density, perceptual = paper.density, paper.photometric.perceptual
    start, stop, size_start, first = steps_of(steps, density.start, density.stop, density.size_start, perceptual.start)
    every = (stop - start) // (density.rounds - 1)
    assert sorted(round_steps(density.start, density.stop, density.rounds, steps)) == list(range(600, 15_000, 100))
    assert steps_of(steps, paper.sh_warmup) == [4 * 1_000], "one more degree every 1,000 steps"
    assert (paper.means_rate, paper.means_times_extent) == (Rate(1.6e-4, 1.6e-6), True)
    assert (paper.log_scales_rate, paper.quats_rate) == (Rate(5e-3), Rate(1e-3))
    assert (density.grow_gradient, density.split_size, density.size_unit) == (2e-4, 0.01, "extent")
    assert (perceptual.region, perceptual.every) == ("person", 1)
    expected = {
        "steps": f"{steps:,}",
        "points": f"{paper.points:,}",
        "features, hidden": f"{paper.features}, {paper.hidden}",
        "directions": f"{paper.directions}: as many as the face has inputs",
        "inputs": "expression coefficients and free joints",
        "sh_degree": f"{paper.sh_degree}",
        "sh_warmup": "the same",
        "sh_higher_share": f"1/{round(1 / paper.sh_higher_share)}",
        "means_rate, means_times_extent": "the same",
        "log_scales_rate, quats_rate": "the same",
        "features_rate, network_rate": "2.5e-3, 2e-3 to 2e-4",
        "factored_bases": "yes" if paper.factored_bases else "no",
        "encoding_gradient": "yes" if paper.encoding_gradient else "no",
        "network_epsilon": f"{paper.network_epsilon:.0e}".replace("e-0", "e-"),
        "encoding_bands, encoding_length": f"{paper.encoding_bands}, {paper.encoding_length} m",
        "density.start, stop, rounds": f"from step {start} to {stop:,}, every {every} steps",
        "density.grow_gradient, split_size, size_unit": "the same",
        "density.prune_size, size_start": f"{density.prune_size} E, from step {size_start}".replace("0.1", ".1"),
        "density.opacity_resets": "none" if not density.opacity_resets else "some",
        "judged_expressions": f"{paper.judged_expressions}",
        "density.max_gaussians": f"{density.max_gaussians:,}",
        "face_tuning": "on" if paper.face_tuning.enabled else "off",
        "photometric.perceptual": f"{perceptual.weight} on the box of the scoring mask, from step {first:,}, "
        "three blocks of a VGG16",
    }
    assert (paper.features_rate, paper.network_rate, perceptual.blocks) == (Rate(2.5e-3), Rate(2e-3, 2e-4), 3)
    assert values_of("HeadGaS") == expected


# -- MonoGaussianAvatar ------------------------------------------------------------------------------------------------


def mono_table() -> dict[str, str]:
    page = PAGE.read_text()
    own = page.split("\n## MonoGaussianAvatar\n")[1].split("\n### ")[0]
    rows = re.findall(r"^\| (`[a-z_., `]+) \|(.*)\|$", own, flags=re.MULTILINE)
    return {name: words for names, words in rows for name in re.findall(r"`([a-z_.]+)`", names)}


def test_mono_gaussian_avatar_has_the_papers_sizes_rates_and_schedules() -> None:
    paper: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    assert PRESETS["paper"].settings_of("mono_gaussian_avatar").steps == 300_000
    sizes = (paper.attribute_width, paper.attribute_layers, paper.deformation_width, paper.change_width)
    assert sizes == (256, 7, 128, 64)
    assert (paper.points, paper.max_points, paper.encoding_bands, paper.sphere_start) == (400, 100_000, 6, True)
    # A head model of four times life size: radius .5, scales .025, rate 1e-4.
    assert (4 * paper.sphere_radius, 4 * paper.scale_gain, 4 * paper.means_rate.start) == (0.5, 0.025, 1e-4)
    assert paper.network_rate == Rate(1e-4)
    assert [round(120 * time) for time in paper.rate_halvings] == [80, 100]
    tuning = paper.face_tuning
    for rate in (tuning.expression, tuning.joints, tuning.head_rotation):
        assert (rate.start, round(rate.begin * 120), rate.end) == (5e-4, 10, None)
    photometric = paper.photometric
    weights = (photometric.l1_weight, photometric.ssim_weight, photometric.perceptual.weight)
    assert weights == (1, 0.25, 0.1)


def test_docs_have_values_of_mono_gaussian_avatar() -> None:
    table = mono_table()
    for name, words in {"max_points": "100,000", "epochs": "120", "attribute_width": "256, 7"}.items():
        assert words in table[name].split("|")[1], name


def test_docs_have_all_values_of_mono_gaussian_avatar() -> None:
    paper: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    steps, tuning, photometric = (
        PRESETS["paper"].settings_of("mono_gaussian_avatar").steps,
        paper.face_tuning,
        paper.photometric,
    )
    halvings = [round(paper.epochs * time) for time in paper.rate_halvings]
    assert (paper.own_rate.start, paper.pretraining, paper.face_points) == (0, 0, paper.max_points)
    assert (photometric.perceptual.crop, photometric.perceptual.blocks) == (224, 3)
    expected = {
        "steps": f"{steps:,}",
        "frames_per_step, points_per_step": f"{paper.frames_per_step}, {paper.points_per_step:,}",
        "start, points, sphere_radius": f"{paper.start}, {paper.points}, {paper.sphere_radius}",
        "pretraining": "0",
        "own_rate": "0",
        "max_points": f"{paper.max_points:,}",
        "first_epoch, epochs": f"{paper.first_epoch}, {paper.epochs}",
        "schedule": paper.schedule,
        "late_epoch": f"{paper.late_epoch}",
        "attribute_width, attribute_layers": f"{paper.attribute_width}, {paper.attribute_layers}",
        "encoding_bands": f"{paper.encoding_bands}",
        "sphere_start": "yes" if paper.sphere_start else "no",
        "deformation_width": f"{paper.deformation_width}",
        "skinning_norm": "yes" if paper.skinning_norm else "no",
        "change_width": f"{paper.change_width}",
        "scale_gain": f"{paper.scale_gain}",
        "means_rate": f"{paper.means_rate.start:.1e}".replace("e-0", "e-"),
        "network_rate": f"{paper.network_rate.start:.0e}".replace("e-0", "e-"),
        "adam_epsilon": f"{paper.adam_epsilon:.0e}".replace("e-0", "e-"),
        "rate_halvings": f"epochs {halvings[0]} and {halvings[1]}",
        "face_skinning_weight": f"{paper.face_skinning_weight:g}",
        "face_expression_weight, face_expression_by_variance": f"{paper.face_expression_weight:,.0f}, "
        + ("yes" if paper.face_expression_by_variance else "no"),
        "face_correctives_weight": f"{paper.face_correctives_weight:,.0f}",
        "face_points": "all points",
        "photometric": "the same",
        "photometric.perceptual": f"{photometric.perceptual.weight:g}, three blocks on crops of 224 pixels"[1:],
        "face_tuning.expression, joints, head_rotation": "5e-4 from epoch 10",
        "face_tuning.head_translation": f"{tuning.head_translation.start:g}",
    }
    assert values_of("MonoGaussianAvatar") == expected


def test_docs_have_the_counts_and_radii_of_both_schedules() -> None:
    rows = re.findall(r"^\| (\d+) \| ([\d,]+) \| (\S+) \| ([\d,]+) \| (\S+) \|$", PAGE.read_text(), flags=re.MULTILINE)
    assert len(rows) == 9
    for epoch, *cells in rows:
        names: tuple[ScheduleName, ...] = ("paper", "code")
        for name, count, radius in zip(names, cells[::2], cells[1::2], strict=True):
            schedule, at = Schedule(name, 120, 400), int(epoch) / 120
            assert f"{schedule.points_at(at):,}" == count, (epoch, name)
            assert f"{4 * schedule.rendering_radius(at):.1e}".replace("e-0", "e-") == radius, (epoch, name)


def updates_of(paper: Any, steps: int) -> int:
    """The number of optimiser steps of a run, whose frames a step are fewer the more points there are."""
    schedule, done, updates = Schedule(paper.schedule, paper.epochs, paper.points), 0, 0
    times = schedule.rounds()
    points = [paper.points, *(min(paper.max_points, schedule.points_at(time)) for time in times)]
    frames = [max(1, min(paper.frames_per_step, paper.points_per_step // count)) for count in points]
    for end, some in zip([*(max(1, round(time * steps)) for time in times), steps], frames, strict=True):
        more = max(0, -(-(end - done) // some))
        done, updates = done + more * some, updates + more
    return updates


def test_the_preset_for_processors_is_that_of_the_paper_with_fewer_frames_and_points() -> None:
    method, small, paper = "mono_gaussian_avatar", PRESETS["paper-cpu"], PRESETS["paper"]
    config: Any = small.config(method)
    assert replace(config, max_points=100_000) == paper.config(method)
    settings = small.settings_of(method)
    assert replace(settings, steps=300_000) == paper.settings_of(method)
    assert [name for name in METHODS if "paper-cpu" in METHODS[name].presets] == [method]
    own = PAGE.read_text().split("\n### On a processor\n")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| `([a-z_]+)` \| (.*) \|$", own, flags=re.MULTILINE))
    frames = settings.steps // config.epochs
    assert rows == {
        "steps": f"300,000: 2,500 frames an epoch | {settings.steps:,}: {frames} frames an epoch",
        "max_points": f"100,000 | {config.max_points:,}",
    }
    ((written, of_paper),) = re.findall(r"about ([\d,]+) updates instead of about ([\d,]+)", own)
    assert updates_of(config, settings.steps) == pytest.approx(int(written), rel=0.01)
    assert updates_of(paper.config(method), 300_000) == pytest.approx(int(of_paper.replace(",", "")), rel=0.01)


# -- PointAvatar -------------------------------------------------------------------------------------------------------


def test_docs_have_all_values_of_point_avatar() -> None:
    paper: Any = PRESETS["paper"].config("point_avatar")
    steps, photometric, tuning = (
        PRESETS["paper"].settings_of("point_avatar").steps,
        paper.photometric,
        paper.face_tuning,
    )
    assert (paper.first_radius, paper.radius_factor) == (0.0375, 0.75)
    weights = (paper.face_skinning_weight, paper.face_expression_weight, paper.face_correctives_weight)
    assert weights == (1, 1_000, 1_000)
    assert (photometric.ssim_weight, photometric.perceptual.every, photometric.perceptual.start) == (0, 1, 0)
    assert paper.face_points >= paper.max_points
    for rate in (tuning.expression, tuning.joints, tuning.head_rotation):
        assert (rate.start, round(rate.begin * paper.epochs), rate.end) == (5e-4, 10, None)
    expected = {
        "steps": f"{steps:,}",
        "frames_per_step": f"{paper.frames_per_step}",
        "start, points, sphere_radius": f"{paper.start}, {paper.points}, {paper.sphere_radius}",
        "pretraining": f"{paper.pretraining}",
        "max_points, growth_epochs, epochs": f"{paper.max_points:,}, {paper.growth_epochs}, {paper.epochs}",
        "first_radius, radius_factor": "the same",
        "normals": paper.normals,
        "surface_width, surface_layers, encoding_bands": f"{paper.surface_width}, {paper.surface_layers}, "
        f"{paper.encoding_bands}",
        "deformation_width": f"{paper.deformation_width}",
        "shading_width": f"{paper.shading_width}",
        "means_rate, network_rate": ", ".join(
            f"{rate.start:g}".replace("e-0", "e-").replace("0.0001", "1e-4")
            for rate in (paper.means_rate, paper.network_rate)
        ),
        "face_skinning_weight, face_expression_weight, face_correctives_weight": "the same",
        "face_points": "all points",
        "distance_weight, slope_weight": f"{paper.distance_weight:g}, {paper.slope_weight:g}",
        "photometric": f"L1 + {photometric.perceptual.weight:g} features + {photometric.alpha_weight:g} alpha".replace(
            "0.1", ".1"
        ),
        "face_tuning": "5e-4 from epoch 10",
        "closing": f"{paper.closing} pixel in every direction",
    }
    assert values_of("PointAvatar") == expected
    assert f"takes {paper.epochs} epochs of\n{steps // paper.epochs:,} frames" in PAGE.read_text()
