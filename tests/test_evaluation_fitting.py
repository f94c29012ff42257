"""Faces fitted to held-out pictures: they come nearer to the truth, leave the avatar alone, and are a third figure."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from evaluation_case import drawn_sequence, make_experiment
from mien.avatar import METHODS
from mien.cli import main
from mien.evaluation import EvaluationSettings, protocols
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.fitting import FittedFaces, fit_face
from mien.evaluation.metrics import l1
from mien.evaluation.partial import PartialScores
from mien.evaluation.protocols import AS_TRACKED, AVATAR, FITTED, evaluate_frames, protocol_content
from mien.evaluation.text import protocol_lines
from mien.tracking import Scoring
from plain_settings import plain_config
from shared_things import MadeOnce, toy_workspace

pytestmark = pytest.mark.unchecked
QUICK = EvaluationSettings(perceptual=False, video_frames=0, baselines=False, threads=1)
FIT = replace(QUICK, fit_faces=True)


def astray(experiment: Experiment) -> Experiment:
    """Return the experiment with face parameters that are a little wrong."""
    (face,) = experiment.faces
    wrong = replace(
        face,
        expression=(face.expression + 0.1).clamp(0, 1),
        head_rotation=face.head_rotation + 0.02,
        head_translation=face.head_translation + torch.tensor([0.004, -0.004, 0.0]),
    )
    return replace(experiment, faces=(wrong,), face_source="corrected")


def drawn_by(method: str) -> Experiment:
    """Return an experiment whose pictures a new avatar of that method drew."""
    base, chosen = make_experiment(5), METHODS[method]
    torch.manual_seed(0)
    avatar = chosen.avatar(plain_config(method), base.avatar.face_model, base.faces[0])
    sequence = drawn_sequence(avatar, base.faces[0], base.sequences[0].tracking.cameras[0])
    scorings = (Scoring(sequence.scoring, base.scorings[0].crops),)
    return replace(base, avatar=avatar, sequences=(sequence,), scorings=scorings)


@pytest.mark.parametrize("method", METHODS)
def test_fitted_faces_draw_the_picture_better_and_change_nothing_else(method: str) -> None:
    experiment = astray(drawn_by(method))
    avatar, frame = experiment.avatar, experiment.held_out_frames[0]
    before = {name: tensor.clone() for name, tensor in avatar.state_dict().items()}
    wanted = [tensor.requires_grad for tensor in avatar.parameters()]
    start = experiment.face(frame)
    truth = target_image(experiment, frame)
    with torch.no_grad():
        fitted = fit_face(experiment, [frame], 20)
    assert l1(avatar_image(experiment, frame, fitted), truth) < 0.9 * l1(avatar_image(experiment, frame), truth)
    assert all(torch.equal(tensor, before[name]) for name, tensor in avatar.state_dict().items())
    assert [tensor.requires_grad for tensor in avatar.parameters()] == wanted
    assert all(tensor.grad is None for tensor in avatar.parameters())
    assert not any(term for group in avatar.parameter_groups() for one in group.factored.values() for term in one.terms)
    assert fitted.identity.equal(start.identity)
    low, high = avatar.face_model.expression_bounds.unbind(-1)
    low, high = start.expression.minimum(low), start.expression.maximum(high)
    assert bool(((fitted.expression >= low) & (fitted.expression <= high)).all())
    assert experiment.face(frame).expression.equal(start.expression)


def test_fits_do_not_depend_on_the_order_of_questions() -> None:
    experiment = astray(make_experiment(10))
    frames = experiment.held_out_frames
    there, back = FittedFaces(experiment, 3), FittedFaces(experiment, 3)
    forward, backward = ({each: fits.face(each) for each in frames[::way]} for fits, way in ((there, 1), (back, -1)))
    assert all(forward[each].expression.equal(backward[each].expression) for each in frames)
    assert there.face(frames[0]) is forward[frames[0]]
    for fits, shown in ((there, FITTED), (None, AVATAR)):
        ((_, drawn, _),) = protocols.drawn_frames(experiment, [frames[0]], {protocols.OPENED}, None, fits)
        assert drawn[protocols.OPENED].equal(protocols.opened(drawn[shown])), "the picture of the fitted face, if any"


def test_the_third_figure_stands_beside_the_others_and_is_never_the_headline(tmp_path: Path) -> None:
    experiment = astray(make_experiment(10))
    plain = evaluate_frames(experiment, QUICK)
    partial = PartialScores(tmp_path / "partial", "one")
    scored = evaluate_frames(experiment, FIT, partial)
    assert set(scored.scores) == {AVATAR, AS_TRACKED, FITTED}
    assert scored.scores[AVATAR] == plain.scores[AVATAR]
    without, entry = (protocol_content(experiment, each, FIT) for each in (plain, scored))
    assert "fitted" not in without
    assert entry["psnr"] == without["psnr"]
    assert entry["fitted"]["psnr"] > entry["psnr"] + 1
    assert entry["fitted"]["head"]["psnr"] > entry["head"]["psnr"]
    assert entry["fitted"]["fit"]["steps"] == 20
    assert "fitted" not in protocol_lines("self_reenactment", entry)[1]
    assert evaluate_frames(experiment, FIT, partial).scores == scored.scores, "resumed"


@pytest.mark.usefixtures("short_films")
def test_the_command_adds_the_figure_only_if_it_is_asked_for(made_once: MadeOnce, tmp_path: Path, capsys) -> None:
    shutil.copytree(toy_workspace(made_once), tmp_path / "W")
    run_dir, command = tmp_path / "W/runs/toy", ["evaluate", str(tmp_path / "W"), "--no-perceptual"]
    assert main(command) == 0
    assert not any("fitted" in (run_dir / name).read_text() for name in ("metrics.json", "report.html"))
    assert main([*command, "--fit-faces", "--fit-steps", "5", "--json"]) == 0
    shown = capsys.readouterr()
    entry = next(iter(json.loads(shown.out)["protocols"].values()))
    assert entry["fitted"]["fit"]["steps"] == 5
    assert "faces fitted to the scored pictures" in shown.err
    assert "Avatar, faces fitted to the scored pictures" in (run_dir / "report.html").read_text()
    assert main(["evaluate", str(tmp_path / "W"), "--compare"]) == 0
    table = capsys.readouterr().out
    assert [line for line in table.splitlines() if line.startswith("toy") and "fitted to the scored pictures" in line]
    assert main(command) == 0
    assert "fitted" not in (run_dir / "metrics.json").read_text()
    for more, told in (
        (["--fit-faces", "--fit-steps", "0"], "--fit-steps 0: give a number from 1 to 10000"),
        (["--fit-faces", "--compare"], "--fit-faces: is for one run"),
    ):
        assert main(["evaluate", str(tmp_path / "W"), *more]) == 2
        assert told in capsys.readouterr().err
