"""Evaluation of an avatar that is itself the truth: it wins, and the baselines are what they claim to be."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation_case import drawn_sequence, make_experiment
from mien.avatar.methods import DEFAULT_METHOD
from mien.evaluation.baselines import make_baselines
from mien.evaluation.experiment import Experiment, avatar_image, head_box, moved, target_image
from mien.evaluation.metrics import crop_to, psnr
from mien.evaluation.protocols import Evaluation, EvaluationSettings, evaluate_frames, protocol_content
from mien.evaluation.report_sections import spans
from mien.evaluation.run_report import RunRecord, write_report
from mien.evaluation.scoring import PART_SIDE, as_8_bit, enlarged, mean_scores, score_pictures
from mien.gaussians import sh_from_rgb
from mien.pages.pages import Axes, Series, line_chart
from mien.perceptual.distance import load_perceptual
from mien.tracking.tracking import PARTS
from mien.training.footage.frames import Frame

experiment = pytest.fixture(scope="module")(lambda: make_experiment(20))
QUICK = EvaluationSettings(perceptual=False, baselines=False)


@pytest.fixture(scope="module")
def evaluation(experiment: Experiment) -> Evaluation:
    return evaluate_frames(experiment, EvaluationSettings())


def test_a_copy_of_the_avatar_draws_elsewhere(experiment: Experiment) -> None:
    """Another dtype stands for another device: faces and cameras follow the copy, and the avatar stays."""
    frame, elsewhere = experiment.held_out_frames[0], moved(experiment, torch.zeros((), dtype=torch.float64))
    pictures = avatar_image(experiment, frame), avatar_image(elsewhere, frame)
    assert [picture.dtype for picture in pictures] == [torch.float32, torch.float64]
    assert psnr(pictures[0], pictures[1].float()) > 60


def test_target_is_the_picture_inside_the_mask_over_white(experiment: Experiment) -> None:
    frame, sequence = experiment.held_out_frames[0], experiment.sequences[0]
    target, alpha = target_image(experiment, frame), torch.from_numpy(experiment.scorings[0].masks[frame[1:]])
    assert bool((target[alpha == 0] == 1).all())
    image = torch.from_numpy(sequence.capture.images[frame[1:]]).float() / 255
    torch.testing.assert_close(target[alpha == 255], image[alpha == 255])
    assert psnr(avatar_image(experiment, frame), target) > 45, "the avatar made the truth"
    # At soft edges it is the person without the wall: each picture becomes one that was filmed before a green one.
    share = sequence.capture.mattes[..., None] / 255.0
    filmed = np.rint(share * sequence.capture.images + (1 - share) * [0.0, 255.0, 0.0]).astype(np.uint8)
    before = replace(experiment, sequences=(replace(sequence, capture=replace(sequence.capture, images=filmed)),))
    soft = torch.from_numpy((share[frame[1:]] > 0.1) & (share[frame[1:]] < 0.9))[..., 0]
    held, left = (
        float((target_image(replace(before, edges=edges), frame) - target)[soft].abs().mean())
        for edges in ("filmed", "cleaned")
    )
    assert held > 0.1
    assert left < 0.35 * held
    # Crops from (10, 20) to (60, 80) and from (30, 5) to (110, 45) span 100 x 75 pixels. The margin is 5 % of 100.
    crops = experiment.scorings[0].crops.copy()
    crops[3, 0], crops[4, 0], crops[5, 0] = (10, 20, 50, 60), (30, 5, 80, 40), (0, 0, 400, 400)
    turned = replace(experiment, scorings=(replace(experiment.scorings[0], crops=crops),))
    assert head_box(turned, [Frame(0, 3, 0), Frame(0, 4, 0)]) == (5, 0, 110, 85)


def test_an_avatar_that_white_shines_through_is_told_over_dark_blue() -> None:
    """The person is white. The avatar of half the opacity looks the same over white, and worse over dark blue."""
    experiment = replace(make_experiment(20), edges="cleaned")
    sequence, store = experiment.sequences[0], experiment.avatar.store
    with torch.no_grad():
        store["sh_constant"].copy_(sh_from_rgb(torch.ones(len(store["sh_constant"]), 3))[:, None])
    white = drawn_sequence(experiment.avatar, sequence.tracking.face, experiment.camera(experiment.held_out_frames[0]))
    scoring = replace(experiment.scorings[0], masks=white.capture.mattes)
    experiment = replace(experiment, sequences=(white,), scorings=(scoring,))
    solid = protocol_content(experiment, evaluate_frames(experiment, QUICK), QUICK)
    with torch.no_grad():
        store["opacity_logits"].fill_(-1.0)
    thin = protocol_content(experiment, evaluate_frames(experiment, QUICK), QUICK)
    assert min(solid["psnr"], solid["over_dark"]["psnr"], thin["psnr"]) > 40
    assert max(thin["over_dark"]["psnr"], thin["over_dark"]["head"]["psnr"]) < 30
    # Only the colours of the person alone are shown over dark blue.
    assert not replace(QUICK, protocol="insta").over_dark(experiment)
    assert "over_dark" not in evaluate_frames(replace(experiment, edges="filmed"), QUICK).scores


def test_the_baseline_mesh_has_the_colors_it_saw_and_beats_the_mean_picture(experiment: Experiment) -> None:
    baselines, frame, model = make_baselines(experiment), experiment.held_out_frames[0], experiment.avatar.face_model
    mean = baselines.mean_frame_image(experiment, frame)
    template = model.template
    paint = (template / template[model.faces].mean(1).abs().max() * 0.5 + 0.5).clamp(0, 1)
    front = (template[:, 2] > 0.05) & (template[:, 0].abs() < 0.04)
    assert float((baselines.vertex_colors - paint)[front].abs().mean()) < 0.05
    assert bool(torch.isfinite(baselines.vertex_colors).all())
    target = target_image(experiment, frame)
    assert psnr(baselines.mesh_image(experiment, frame), target) > psnr(mean, target) + 3


def test_metrics_have_the_documented_layout_and_order(experiment: Experiment, evaluation: Evaluation) -> None:
    settings = EvaluationSettings()
    content = json.loads(json.dumps(protocol_content(experiment, evaluation, settings), allow_nan=False))
    assert content["frames"] == 4 == len(content["per_frame"]["psnr"])
    assert content["per_frame"]["timestep"] == list(range(16, 20))
    assert (content["split"], content["face_params"]) == ("blocks", "as_tracked")
    assert content["perceptual_backbone"] == "st-lpips-alex"
    mean, mesh = content["baselines"]["mean_frame"], content["baselines"]["mesh"]
    assert all({"psnr", "ssim", "l1", "perceptual"} <= set(entry) for entry in (content, content["head"], mean, mesh))
    assert content["psnr"] > content["head"]["psnr"] > 40, "the white border must raise the whole frame's figure"
    assert content["psnr"] > mesh["psnr"] > mean["psnr"]
    assert content["perceptual"] < mesh["perceptual"] < mean["perceptual"]
    assert content["psnr"] == pytest.approx(np.mean(content["per_frame"]["psnr"]), abs=1e-4)
    ranked = [evaluation.scores["avatar"][i]["head_psnr"] for i in evaluation.ranked()]
    assert ranked == sorted(ranked)
    # Frames with a hand are scored and counted.
    assert "covered_frames" not in content
    sequence = experiment.sequences[0]
    covered = torch.zeros(len(sequence.tracking.valid), 1, len(PARTS), dtype=torch.bool)
    covered[[frame.timestep for frame in evaluation.frames[:3]], 0, 0] = True
    hand = replace(sequence, tracking=replace(sequence.tracking, covered=covered))
    content = protocol_content(replace(experiment, sequences=(hand,)), evaluation, settings)
    assert (content["covered_frames"], content["frames"]) == (3, 4)


def test_eyes_have_figures_of_their_own(experiment: Experiment, evaluation: Evaluation) -> None:
    content = protocol_content(experiment, evaluation, EvaluationSettings())
    frame = experiment.held_out_frames[0]
    (box,) = experiment.parts(frame).values()
    image, target = as_8_bit(avatar_image(experiment, frame)), target_image(experiment, frame)
    assert content["per_frame"]["eyes_psnr"][0] == pytest.approx(psnr(image, target, box), abs=1e-4)
    cut, goal = (enlarged(crop_to(picture, box), PART_SIDE) for picture in (image, target))
    assert min(cut.shape[:2]) == PART_SIDE
    for shape, larger in (((10, 20, 3), (15, 30, 3)), ((20, 10, 3), (30, 15, 3)), ((20, 15, 3), (20, 15, 3))):
        assert enlarged(torch.zeros(shape), 15).shape == larger, "by the shorter side, in its proportions"
    assert content["per_frame"]["eyes_perceptual"][0] == pytest.approx(load_perceptual()(cut, goal), abs=1e-4)
    assert content["eyes"]["psnr"] == pytest.approx(np.mean(content["per_frame"]["eyes_psnr"]), abs=1e-4)
    assert content["baselines"]["mesh"]["eyes"]["psnr"] < content["eyes"]["psnr"]
    assert "mouth" not in content, "the face model has no lips"
    # Frames that show no eyes are left out of their figures.
    pictures, target = {"image": torch.full((40, 50, 3), 0.5)}, torch.full((40, 50, 3), 0.6)
    with_eyes = score_pictures(pictures, target, None, None, {"eyes": (5, 6, 20, 10)})["image"]
    without = score_pictures(pictures, target, None, None)["image"]
    assert mean_scores([without, with_eyes])["eyes"]["psnr"] == pytest.approx(20.0, abs=1e-3)
    assert "eyes" not in mean_scores([without])


def test_figures_do_not_depend_on_threads_or_on_other_subjects(experiment: Experiment, evaluation: Evaluation) -> None:
    few = replace(experiment, held_out_frames=experiment.held_out_frames[:3])
    alone = evaluate_frames(few, replace(QUICK, threads=1))
    together = evaluate_frames(few, EvaluationSettings(perceptual=False, threads=3))
    assert alone.scores == {"avatar": together.scores["avatar"]}
    content = protocol_content(few, alone, QUICK)
    assert (content["perceptual"], content["perceptual_frames"], content["perceptual_backbone"]) == (None, 0, None)
    # The perceptual metric on some frames only.
    settings = EvaluationSettings(perceptual_frames=2, baselines=False)
    content = protocol_content(experiment, evaluate_frames(experiment, settings), settings)
    assert [figure is not None for figure in content["per_frame"]["perceptual"]] == [True, False] * 2
    assert content["perceptual_frames"] == 2
    known = [row["perceptual"] for row in evaluation.scores["avatar"]]
    assert content["perceptual"] == pytest.approx((known[0] + known[2]) / 2)


def _run_record() -> RunRecord:
    steps = np.arange(1.0, 301.0)
    return RunRecord(
        name="first",
        config={
            "method": {"kind": DEFAULT_METHOD}, "settings": {"kind": "TrainSettings"}, "data": [{"sequence": "clip"}],
            "mien": "0.1.0", "command_line": ["/somewhere/bin/mien", "create", "<clip>.mp4"],
        },
        summary={"steps": 300, "seconds": 71.0, "gaussians": 1234, "step_ms_median": 5.25, "peak_memory_mb": 900.0},
        curves={
            "step": steps, "loss": 1 / steps, "psnr": 20 + np.log(steps), "gaussians": 1000 + steps,
            "step_ms": np.where(steps == 1, 900.0, 5 + np.sin(steps)),
        },
    )  # fmt: skip


def test_report_stands_alone_shows_everything_and_survives_gaps(
    experiment: Experiment, evaluation: Evaluation, tmp_path: Path
) -> None:
    protocols = {"self_reenactment": protocol_content(experiment, evaluation, EvaluationSettings())}
    results = {"self_reenactment": (experiment, evaluation)}
    write_report(tmp_path / "report.html", _run_record(), protocols, results, {}, None, None)
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r"https?://|<script|<link|url\(|/somewhere", page)
    assert "mien create &#39;&lt;clip&gt;.mp4&#39;" in page, "the command must be there, quoted and escaped"
    for wanted in ("Held-out frames", "worst", "Mean training picture", "Gaussians", "1 min 11 s", ">Eyes<"):
        assert wanted in page
    for tag in set(re.findall(r"</(\w+)>", page)):
        assert len(re.findall(rf"<{tag}\b[^>]*(?<!/)>", page)) == page.count(f"</{tag}>"), f"<{tag}> is left open"
    assert (page.count("<img"), page.count("<svg")) == (3 * 6 + 4, 1 + 4 + 1)
    assert f"{protocols['self_reenactment']['head']['psnr']:.2f}" in page
    x = np.arange(4.0)
    flat, gap, none = (
        line_chart([Series("one", x, np.array(values))], Axes("step", "loss"))
        for values in ([1.0] * 4, [1.0, np.nan, 2.0, 3.0], [np.nan] * 4)
    )
    assert (flat.count("L"), gap.count("M")) == (3, 2)
    assert "nan" not in flat + gap
    assert "There are no values to draw" in none
    assert spans([]) == ()
    assert spans([3, 4, 5, 9]) == ((2.5, 5.5), (8.5, 9.5)), "neighbours are joined"
