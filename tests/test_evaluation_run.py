"""A run's folder becomes metrics.json and report.html, through the files that the earlier stages write."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from evaluation_case import make_experiment
from mien.avatar import DEFAULT_METHOD, FaceTuning
from mien.capture import read_capture_hash, write_capture
from mien.errors import UserError
from mien.evaluation import EvaluationSettings, evaluate, read_metrics
from mien.evaluation.evaluate import is_evaluated
from mien.evaluation.load import load_experiments
from mien.evaluation.scoring import METRICS
from mien.storage import read_tensors, write_tensors
from mien.tracking import write_scoring, write_tracking
from mien.training import read_sequence, train
from plain_settings import plain_config, plain_run

pytestmark = pytest.mark.usefixtures("short_films")
STEPS = 5


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a sequence, and a run that was trained on it for a few steps."""
    root = tmp_path_factory.mktemp("workspace")
    folder, run_dir = root / "sequences" / "clip", root / "runs" / "first"
    experiment = make_experiment(20)
    sequence = experiment.sequences[0]
    write_capture(folder / "capture", sequence.capture)
    write_tracking(folder / "tracking", sequence.tracking)
    write_scoring(folder / "scoring", experiment.scorings[0], read_capture_hash(folder / "capture"))
    settings = plain_run(steps=STEPS, record_every=1, checkpoint_every=STEPS)
    config = plain_config(DEFAULT_METHOD, face_tuning=FaceTuning(enabled=False))
    train([read_sequence(folder)], experiment.avatar.face_model, config, settings, run_dir)
    return folder, run_dir


@pytest.fixture(scope="module")
def evaluated(made: tuple[Path, Path]) -> dict[str, Any]:
    """Return all figures of the run."""
    return evaluate(made[1], [made[0]])


@pytest.fixture
def workspace(made: tuple[Path, Path], evaluated: dict[str, Any], tmp_path: Path) -> tuple[Path, Path]:
    """Return a copy of sequence and evaluated run for one test."""
    folder, run_dir = (Path(shutil.copytree(path, tmp_path / path.name)) for path in made)
    return folder, run_dir


def test_evaluate_writes_metrics_and_report(made: tuple[Path, Path], evaluated: dict[str, Any]) -> None:
    run_dir, returned = made[1], evaluated
    stored = json.loads((run_dir / "metrics.json").read_text())
    assert (stored["format"], stored["version"]) == ("mien.metrics", 1)
    assert read_metrics(run_dir) == json.loads(json.dumps(returned))
    entry = stored["protocols"]["self_reenactment"]
    assert set(METRICS) <= set(entry)
    assert set(entry["head"]) == set(METRICS)
    assert set(entry["baselines"]) == {"mean_frame", "mesh"}
    assert (entry["split"], entry["frames"], entry["face_params"]) == ("blocks", 4, "as_tracked")
    wanted = {"steps", "seconds", "gaussians", "step_ms_median", "peak_memory_mb"}
    assert wanted <= set(stored["training"])
    assert stored["training"]["steps"] == STEPS
    page = (run_dir / "report.html").read_text()
    assert page.count("<img") == 34, "28, truth and avatar over dark blue, a filmed frame, and the strip of faces"
    assert "Filmed and made up" in page
    assert page.count(", over dark blue</figcaption>") == 2
    assert f"{entry['psnr']:.2f} dB" in page


@pytest.mark.unchecked
def test_what_is_scored_is_known_to_be(workspace: tuple[Path, Path], evaluated: dict[str, Any]) -> None:
    folder, run_dir = workspace
    whole, short = evaluated["protocols"]["self_reenactment"], EvaluationSettings(perceptual_of="avatar")
    assert is_evaluated(run_dir, [folder], short)  # It has all figures of the short scoring, and more.
    entry = evaluate(run_dir, [folder], short)["protocols"]["self_reenactment"]
    assert entry["perceptual"] == whole["perceptual"]
    assert entry["baselines"]["mesh"]["psnr"] == whole["baselines"]["mesh"]["psnr"]
    assert entry["baselines"]["mesh"]["perceptual"] is None
    assert whole["baselines"]["mesh"]["perceptual"] is not None
    assert not is_evaluated(run_dir, [folder])
    quick = EvaluationSettings(perceptual=False, video_frames=0)
    (run_dir / "metrics.json").unlink()
    assert not is_evaluated(run_dir, [folder], quick)
    evaluate(run_dir, [folder], quick)
    assert is_evaluated(run_dir, [folder], quick)
    assert not is_evaluated(run_dir, [folder], EvaluationSettings(perceptual=False, baselines=False))
    assert not is_evaluated(run_dir, [folder], replace(quick, edges="filmed"))
    (run_dir / "report.html").unlink()
    assert not is_evaluated(run_dir, [folder], quick)


@pytest.mark.unchecked
def test_figures_of_other_scoring_masks_are_not_kept(workspace: tuple[Path, Path]) -> None:
    """The masks of a sequence are written anew, and larger. Neither perceptual metric nor baselines are asked for."""
    folder, run_dir = workspace
    quick = EvaluationSettings(perceptual=False, baselines=False, video_frames=0)
    before = evaluate(run_dir, [folder], quick)
    entry = before["protocols"]["self_reenactment"]
    assert (entry["perceptual"], entry["baselines"]) == (None, {})
    assert "This evaluation did not score the baselines" in (run_dir / "report.html").read_text()
    shutil.rmtree(folder / "scoring")
    scoring = make_experiment(20).scorings[0]
    white = replace(scoring, masks=np.full_like(scoring.masks, 255))
    write_scoring(folder / "scoring", white, read_capture_hash(folder / "capture"))
    assert not is_evaluated(run_dir, [folder], quick)
    after = evaluate(run_dir, [folder], quick)
    assert after["fingerprints"] != before["fingerprints"], "figures of an interrupted evaluation are kept by these"
    old, new = (result["protocols"]["self_reenactment"]["per_frame"]["psnr"] for result in (before, after))
    assert all(first != second for first, second in zip(old, new, strict=True))


def test_held_out_frames_are_those_training_left_out_and_said_to_be_corrected(workspace: tuple[Path, Path]) -> None:
    folder, run_dir = workspace
    experiment = load_experiments(run_dir, [folder])["self_reenactment"]
    assert [frame.timestep for frame in experiment.held_out_frames] == list(range(16, 20))
    assert [frame.timestep for frame in experiment.training_frames] == list(range(16))
    path = run_dir / "face_track.safetensors"
    before = {name: tensor.clone() for name, tensor in read_tensors(path).items()}
    for timestep, wanted in ((3, "as_tracked"), (17, "corrected")):
        changed = {name: tensor.clone() for name, tensor in before.items()}
        changed["expression"][timestep] += 0.1
        write_tensors(path, changed)
        experiment = load_experiments(run_dir, [folder])["self_reenactment"]
        assert experiment.face_source == wanted
        torch.testing.assert_close(experiment.faces[0].expression, changed["expression"])


def test_wrong_sequences_and_unfinished_runs(made: tuple[Path, Path], tmp_path: Path) -> None:
    folder, run_dir = made
    with pytest.raises(UserError, match="was trained on clip"):
        evaluate(run_dir, [folder.with_name("other")])
    with pytest.raises(UserError, match="missing"):
        evaluate(tmp_path, [folder])
    with pytest.raises(UserError, match="missing"):
        read_metrics(tmp_path)
    shutil.copy(run_dir / "config.json", tmp_path)
    with pytest.raises(UserError, match="was not finished; run the same `mien train` or `mien create` again"):
        evaluate(tmp_path, [folder])


def test_masks_of_other_pictures_are_refused(workspace: tuple[Path, Path]) -> None:
    folder, run_dir = workspace
    shutil.rmtree(folder / "scoring")
    write_scoring(folder / "scoring", make_experiment(20).scorings[0], capture_hash="of another capture")
    for read in (lambda: evaluate(run_dir, [folder]), lambda: read_sequence(folder)):
        with pytest.raises(UserError, match=r"scoring: its masks belong to other pictures .* run `mien track` again"):
            read()
