"""A run's folder becomes metrics.json and report.html, through the files that the earlier stages write.
Runs are scored by time, by sequence and by camera; tables compare them."""

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from evaluation_case import make_experiment, two_cameras, write_run, write_sequence
from mien.capture.store import read_capture_hash
from mien.cli import main
from mien.disk.files import read_tensors, write_json, write_tensors
from mien.evaluation import evaluate, protocols
from mien.evaluation.baselines import make_baselines
from mien.evaluation.compare import compare_runs
from mien.evaluation.evaluate import is_evaluated
from mien.evaluation.experiment import Experiment, head_box, target_image
from mien.evaluation.load import held_out_by_protocol, load_experiments
from mien.evaluation.metrics import crop_to
from mien.evaluation.metrics_file import read_metrics
from mien.evaluation.protocols import EvaluationSettings
from mien.evaluation.scoring import METRICS
from mien.evaluation.text import comparison_text, protocol_lines
from mien.evaluation.videos import choose_video_frames, match_sizes
from mien.media.pictures import to_uint8
from mien.media.video import probe_video, read_video_frames
from mien.tracking.scoring_files import write_scoring
from mien.training import read_sequence
from mien.training.footage.frames import Frame, spread_frames
from plain_settings import plain_run
from refusals import refuses

pytestmark = pytest.mark.usefixtures("short_films")
STEPS = 6


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root, experiment = tmp_path_factory.mktemp("workspace"), make_experiment(20)
    folder = write_sequence(root, experiment, experiment.sequences[0])
    settings = plain_run(steps=STEPS, record_every=1, checkpoint_every=STEPS)
    write_run(root / "runs" / "first", experiment, [folder], settings)
    return folder, root / "runs" / "first"


evaluated = pytest.fixture(scope="module")(lambda made: evaluate(made[1], [made[0]]))


@pytest.fixture
def workspace(made: tuple[Path, Path], evaluated: dict[str, Any], tmp_path: Path) -> tuple[Path, Path]:
    folder, run_dir = (Path(shutil.copytree(path, tmp_path / path.name)) for path in made)
    return folder, run_dir


def test_evaluate_writes_metrics_and_report(made: tuple[Path, Path], evaluated: dict[str, Any]) -> None:
    run_dir = made[1]
    stored = json.loads((run_dir / "metrics.json").read_text())
    assert (stored["format"], stored["version"]) == ("mien.metrics", 1)
    assert read_metrics(run_dir) == json.loads(json.dumps(evaluated))
    entry = stored["protocols"]["self_reenactment"]
    assert set(METRICS) == set(entry["head"]) <= set(entry)
    assert set(entry["baselines"]) == {"mean_frame", "mesh"}
    assert (entry["split"], entry["frames"], entry["face_params"]) == ("blocks", 4, "as_tracked")
    assert {"seconds", "gaussians", "step_ms_median", "peak_memory_mb"} <= set(stored["training"])
    assert stored["training"]["steps"] == STEPS
    page = (run_dir / "report.html").read_text()
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
    path = run_dir / "face_track.safetensors"
    before = {name: tensor.clone() for name, tensor in read_tensors(path).items()}
    for timestep, wanted in ((3, "as_tracked"), (17, "corrected")):
        expression = before["expression"].clone()
        expression[timestep] += 0.1
        write_tensors(path, {**before, "expression": expression})
        experiment = load_experiments(run_dir, [folder])["self_reenactment"]
        assert experiment.face_source == wanted
        torch.testing.assert_close(experiment.faces[0].expression, expression)


def test_wrong_sequences_and_unfinished_runs(made: tuple[Path, Path], tmp_path: Path) -> None:
    folder, run_dir = made
    refuses("was trained on clip", evaluate, run_dir, [folder.with_name("other")])
    refuses("missing", evaluate, tmp_path, [folder])
    refuses("missing", read_metrics, tmp_path)
    shutil.copy(run_dir / "config.json", tmp_path)
    refuses("was not finished; run the same `mien train` or `mien create` again", evaluate, tmp_path, [folder])


def test_masks_of_other_pictures_are_refused(workspace: tuple[Path, Path]) -> None:
    folder, run_dir = workspace
    shutil.rmtree(folder / "scoring")
    write_scoring(folder / "scoring", make_experiment(20).scorings[0], capture_hash="of another capture")
    for read in (lambda: evaluate(run_dir, [folder]), lambda: read_sequence(folder)):
        refuses(r"scoring: its masks belong to other pictures .* run `mien track` again", read)


QUICK = EvaluationSettings(perceptual=False, video_frames=16)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace of two sequences with two cameras each, and of runs with and without held-out parts."""
    root = tmp_path_factory.mktemp("rig") / "anna"
    experiment = make_experiment(20)
    folders = [write_sequence(root, experiment, two_cameras(experiment, name)) for name in ("talk", "laugh")]
    short = plain_run(steps=STEPS, record_every=1, checkpoint_every=STEPS)
    held = replace(short, held_out_sequences=("laugh",), held_out_cameras=("side",))
    write_run(root / "runs" / "held", experiment, folders, held)
    write_run(root / "runs" / "longer", experiment, folders[:1], replace(short, steps=2 * STEPS))
    write_run(root / "runs" / "short", experiment, folders[:1], short)
    return root


@pytest.fixture(scope="module")
def experiments(root: Path) -> dict[str, Experiment]:
    return load_experiments(root / "runs" / "held", [root / "sequences" / name for name in ("talk", "laugh")])


@pytest.fixture(scope="module")
def scored(root: Path) -> dict[str, dict]:
    held = {"held": ("talk", "laugh"), "short": ("talk",), "longer": ("talk",)}
    folders = {run: [root / "sequences" / name for name in names] for run, names in held.items()}
    return {run: evaluate(root / "runs" / run, folders[run], QUICK) for run in held}


@pytest.mark.unchecked
def test_protocols_hold_what_training_left_out(experiments: dict[str, Experiment], scored: dict[str, dict]) -> None:
    frames = {name: set(one.held_out_frames) for name, one in experiments.items()}
    assert frames == {
        "self_reenactment": {Frame(0, t, c) for t in range(16, 20) for c in (0, 1)},
        "self_reenactment_sequence": {Frame(1, t, c) for t in range(20) for c in (0, 1)},
        "novel_view": {Frame(0, t, 1) for t in range(16)},
    }
    assert set(experiments["novel_view"].training_frames) == {Frame(0, t, 0) for t in range(16)}
    assert {one.split for one in experiments.values()} == {"blocks", "sequences", "cameras"}
    # A timestep that no training camera saw is no novel view: its face is not known.
    talk, valid = experiments["novel_view"].sequences[0], np.arange(40).reshape(20, 2) != 6
    (_, views) = held_out_by_protocol(
        [replace(talk, capture=replace(talk.capture, valid=valid))], plain_run(held_out_cameras=("side",))
    )["novel_view"]
    assert views == tuple(Frame(0, t, 1) for t in range(16) if t != 3)
    assert {one.face_source for one in experiments.values()} == {"as_tracked"}
    # Figures say what they are of.
    sequence, view = (scored["held"]["protocols"][name] for name in ("self_reenactment_sequence", "novel_view"))
    assert (sequence["sequences"], sequence["camera_ids"], sequence["frames"]) == (["laugh"], ["front", "side"], 40)
    assert (view["sequences"], view["camera_ids"], view["frames"]) == (["talk"], ["side"], 16)
    assert set(view["scored_on"]["talk"]) == {"pictures", "mask"}
    assert sequence["as_tracked"]["psnr"] == sequence["psnr"]
    assert sequence["pixels"].startswith("8 bits")


def test_mean_frame_is_of_the_sequence_and_camera_where_it_can_be(experiments: dict[str, Experiment]) -> None:
    experiment = experiments["novel_view"]
    both = tuple(Frame(0, t, c) for t in range(3) for c in (0, 1)) + tuple(Frame(1, t, 0) for t in range(5, 8))
    wide = make_baselines(replace(experiment, training_frames=both))
    for sought, sequence, camera, timesteps in (
        (Frame(0, 17, 0), 0, 0, range(3)), (Frame(0, 17, 1), 0, 1, range(3)), (Frame(1, 17, 0), 1, 0, range(5, 8)),
        (Frame(1, 9, 1), 0, 1, range(3)),  # only the camera is the same
    ):  # fmt: skip
        frames = [Frame(sequence, t, camera) for t in timesteps]
        wanted = torch.stack([target_image(experiment, frame) for frame in frames]).mean(0)
        torch.testing.assert_close(wide.mean_frame_image(experiment, sought), wanted, atol=1e-5, rtol=0)


@pytest.mark.unchecked
@pytest.mark.usefixtures("scored")
def test_each_protocol_has_a_video_and_a_place_in_the_report(root: Path, experiments: dict[str, Experiment]) -> None:
    run_dir = root / "runs" / "held"
    for name, frames in (("self_reenactment", 8), ("self_reenactment_sequence", 16), ("novel_view", 16)):
        assert probe_video(run_dir / "videos" / f"{name}.mp4").frames == frames
    assert (run_dir / "report.html").read_text().count("<video") == 4, "the film of the avatar comes first"
    _, first = next(read_video_frames(run_dir / "videos" / "novel_view.mp4"))
    experiment = experiments["novel_view"]
    box = head_box(experiment, list(experiment.held_out_frames))
    wanted = to_uint8(crop_to(target_image(experiment, experiment.held_out_frames[0]), box)).astype(int)
    height, width = wanted.shape[:2]
    truth, rendering, error = (first[26 : 26 + height, i * (width + 4) :][:, :width].astype(int) for i in range(3))
    assert np.abs(truth - wanted).mean() < 8
    assert np.abs(rendering - wanted).mean() > 20, "some steps of training do not make a likeness"
    assert error[:4, :4].mean() < 20, "no error beside the head"


def test_long_videos_show_every_camera_from_its_first_frame() -> None:
    frames = [Frame(0, t, c) for t in range(30) for c in (0, 1)]
    assert choose_video_frames(frames, 10) == [Frame(0, t, c) for c in (0, 1) for t in range(5)]
    assert len(choose_video_frames(frames, 60)) == 60
    pictures = [np.zeros((8, 9, 3), np.uint8), np.zeros((20, 4, 3), np.uint8)]
    assert [picture.shape for picture in match_sizes(iter(pictures))] == [(8, 9, 3)] * 2
    many = [Frame(s, t, c) for s in range(2) for t in range(32) for c in range(4)]
    chosen = spread_frames(many, 32)
    assert len(chosen) <= 32
    assert {(frame.sequence, frame.camera) for frame in chosen} == {(s, c) for s in range(2) for c in range(4)}
    assert spread_frames(many, 0) == sorted(many, key=lambda f: (f.sequence, f.camera, f.timestep))


@pytest.mark.unchecked
def test_evaluation_goes_on_where_it_was(root: Path, scored: dict[str, dict], monkeypatch) -> None:
    run_dir, folder = root / "runs" / "short", root / "sequences" / "talk"
    quick = replace(QUICK, video_frames=0, baselines=False)
    drawn: list[Frame] = []
    original = protocols.drawn_frames

    def stopping(experiment: Experiment, frames: list[Frame], *more: object) -> Iterator:
        for item in original(experiment, frames, *more):  # type: ignore[arg-type]
            drawn.append(item[0])
            yield item
            if len(drawn) == 6:
                raise KeyboardInterrupt

    monkeypatch.setattr(protocols, "drawn_frames", stopping)
    pytest.raises(KeyboardInterrupt, evaluate, run_dir, [folder], quick)
    partial = run_dir / ".self_reenactment.partial"
    kept = len(partial.read_text().splitlines()) - 1
    assert kept >= 2
    partial.write_text(partial.read_text() + '{"frame": [0, 19')
    again = evaluate(run_dir, [folder], quick)
    assert len(drawn) == 6 + 8 - kept
    assert not partial.exists()
    entry, before = again["protocols"]["self_reenactment"], scored["short"]["protocols"]["self_reenactment"]
    assert entry["per_frame"] == before["per_frame"]
    partial.write_text('{"scores_of": "something else"}\n{"frame": [0, 16, 0], "scores": {}, "seconds": 1}\n')
    assert evaluate(run_dir, [folder], quick)["protocols"]["self_reenactment"]["per_frame"] == entry["per_frame"]


def test_comparison_ranks_runs_of_the_same_frames(scored: dict[str, dict], root: Path) -> None:
    comparison = compare_runs({name: root / "runs" / name for name in ("short", "longer")})
    (table,) = comparison.tables
    assert comparison.warnings == ()
    figures = {name: entry["protocols"]["self_reenactment"]["psnr"] for name, entry in scored.items()}
    assert table.best(None, "psnr", True) == round(max(figures["short"], figures["longer"]), 2)
    assert table.best(None, "l1", False) == min(round(r.entry["l1"], 4) for r in table.rows if r.run)
    assert f"\x1b[1m{figures['longer']:.2f}\x1b[0m" in comparison_text(comparison, bold=True)
    lines = [line for line in comparison_text(comparison).splitlines() if "." in line and "held-out" not in line]
    names = [line.split("  ")[0] for line in lines]
    dark = ["short, over dark blue", "longer, over dark blue"]
    assert names == ["short", "longer", "mean training picture", "coloured mesh", *dark]


@pytest.mark.parametrize("other_in", ["mask", "edges"])
@pytest.mark.usefixtures("scored")
def test_comparison_warns_of_other_frames_masks_and_missing_runs(root: Path, tmp_path: Path, other_in: str) -> None:
    content = read_metrics(root / "runs" / "short")
    entry = content["protocols"]["self_reenactment"]
    if other_in == "mask":
        entry["scored_on"]["talk"]["mask"] = "another"
    else:
        entry["edges"] = "filmed"
    other = tmp_path / "other"
    other.mkdir()
    write_json(other / "metrics.json", "mien.metrics", 1, content)
    shutil.copy(root / "runs" / "short" / "config.json", other)
    comparison = compare_runs({"short": root / "runs" / "short", "other": other, "never": tmp_path / "never"})
    assert len(comparison.tables) == 2
    warnings = "\n".join(comparison.warnings)
    write_json(other / "metrics.json", "mien.metrics", 99, {})
    refuses(r"version 99.*version 1", read_metrics, other)
    if other_in == "mask":
        assert "because they were scored on other frames, pictures or masks: short | other" in warnings
    else:
        assert "because they were scored on other soft edges: short (cleaned) | other (filmed); score them" in warnings
        assert [table.edges for table in comparison.tables] == ["cleaned", "filmed"]
        assert "blocks, soft edges as filmed)" in comparison_text(comparison)
    assert "never: was not evaluated" in warnings
    refuses("no evaluated run", compare_runs, {"never": tmp_path / "never"})


@pytest.mark.unchecked
def test_compare_command(scored: dict[str, dict], root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "compare", str(root), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["format"], printed["version"]) == ("mien.comparison", 1)
    assert ("novel_view", 4) in {(table["protocol"], len(table["rows"])) for table in printed["tables"]}
    assert "://" not in (root / "compare.html").read_text()
    assert main(["evaluate", "compare", str(root), str(root / "runs" / "none")]) == 2


def test_closing_lines_say_what_each_figure_is_of(scored: dict[str, dict]) -> None:
    entry = scored["held"]["protocols"]["novel_view"]
    first, *lines = protocol_lines("novel_view", entry)
    assert first.endswith("novel_view (cameras, 16 frames): PSNR of the whole frame / of the head crop")
    mesh, dark = entry["baselines"]["mesh"], entry["over_dark"]
    rows = {"avatar, faces as tracked": entry, "avatar, over dark blue": dark, "coloured mesh": mesh}
    for words, figures in rows.items():
        wanted = rf"  {words} +{figures['psnr']:.2f} / {figures['head']['psnr']:.2f} dB"
        assert any(re.fullmatch(wanted, line) for line in lines), words
