"""Runs are evaluated by time, by sequence and by camera, from folders as the commands do; tables compare them."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation_case import make_experiment, two_cameras, write_run, write_sequence
from mien.capture.video import probe_video, read_video_frames
from mien.cli import main
from mien.errors import UserError
from mien.evaluation import EvaluationSettings, evaluate, protocols, read_metrics
from mien.evaluation.baselines import make_baselines
from mien.evaluation.compare import compare_runs
from mien.evaluation.experiment import Experiment, head_box, target_image
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import crop_to
from mien.evaluation.protocols import evaluate_frames
from mien.evaluation.text import comparison_text, protocol_lines
from mien.evaluation.videos import choose_video_frames, match_sizes
from mien.pictures import to_uint8
from mien.storage import write_json
from mien.training.footage.frames import Frame, spread_frames
from plain_settings import plain_run

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
QUICK = EvaluationSettings(perceptual=False, video_frames=16)
STEPS = 6


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
    """Return metrics.json of the three runs."""
    folders = {name: root / "sequences" / name for name in ("talk", "laugh")}
    metrics = {"held": evaluate(root / "runs" / "held", list(folders.values()), QUICK)}
    for name in ("short", "longer"):
        metrics[name] = evaluate(root / "runs" / name, [folders["talk"]], QUICK)
    return metrics


def test_protocols_hold_what_training_left_out(experiments: dict[str, Experiment]) -> None:
    frames = {name: set(one.held_out_frames) for name, one in experiments.items()}
    assert set(frames) == {"self_reenactment", "self_reenactment_sequence", "novel_view"}
    assert frames["self_reenactment"] == {Frame(0, t, c) for t in range(16, 20) for c in (0, 1)}
    assert frames["self_reenactment_sequence"] == {Frame(1, t, c) for t in range(20) for c in (0, 1)}
    assert frames["novel_view"] == {Frame(0, t, 1) for t in range(16)}
    trained = set(experiments["novel_view"].training_frames)
    assert trained == {Frame(0, t, 0) for t in range(16)}
    assert not any(trained & held for held in frames.values())
    assert {one.split for one in experiments.values()} == {"blocks", "sequences", "cameras"}
    assert {one.face_source for one in experiments.values()} == {"as_tracked"}


def test_mean_frame_is_of_the_sequence_and_camera_where_it_can_be(experiments: dict[str, Experiment]) -> None:
    experiment = experiments["novel_view"]
    both = tuple(Frame(0, t, c) for t in range(3) for c in (0, 1)) + tuple(Frame(1, t, 0) for t in range(5, 8))
    wide = make_baselines(replace(experiment, training_frames=both))

    def mean(frames: list[Frame]) -> torch.Tensor:
        return torch.stack([target_image(experiment, frame) for frame in frames]).mean(0)

    for sequence, camera, timesteps in ((0, 0, range(3)), (0, 1, range(3)), (1, 0, range(5, 8))):
        wanted = mean([Frame(sequence, t, camera) for t in timesteps])
        found = wide.mean_frame_image(experiment, Frame(sequence, 17, camera))
        torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)
    same_camera = mean([Frame(0, t, 1) for t in range(3)])
    torch.testing.assert_close(wide.mean_frame_image(experiment, Frame(1, 9, 1)), same_camera, atol=1e-5, rtol=0)


def test_spread_frames_meet_every_camera() -> None:
    frames = [Frame(s, t, c) for s in range(2) for t in range(32) for c in range(4)]
    chosen = spread_frames(frames, 32)
    assert len(chosen) <= 32
    assert {frame.camera for frame in chosen} == {0, 1, 2, 3}
    assert {frame.sequence for frame in chosen} == {0, 1}
    assert spread_frames(frames, 0) == sorted(frames, key=lambda f: (f.sequence, f.camera, f.timestep))


def test_metrics_say_what_they_are_of(scored: dict[str, dict], root: Path) -> None:
    stored = json.loads((root / "runs" / "held" / "metrics.json").read_text())
    assert (stored["format"], stored["version"]) == ("mien.metrics", 1)
    sequence, view = (scored["held"]["protocols"][name] for name in ("self_reenactment_sequence", "novel_view"))
    assert (sequence["sequences"], sequence["camera_ids"], sequence["frames"]) == (["laugh"], ["front", "side"], 40)
    assert (view["sequences"], view["camera_ids"], view["frames"]) == (["talk"], ["side"], 16)
    assert set(view["scored_on"]["talk"]) == {"pictures", "mask"}
    assert sequence["as_tracked"]["psnr"] == sequence["psnr"]
    for entry in (sequence, view):
        assert set(entry["baselines"]) == {"mean_frame", "mesh"}
        assert entry["pixels"].startswith("8 bits")


def test_unknown_version_is_named(scored: dict[str, dict], root: Path, tmp_path: Path) -> None:
    write_json(tmp_path / "metrics.json", "mien.metrics", 99, {})
    with pytest.raises(UserError, match=r"version 99.*version 1"):
        read_metrics(tmp_path)


def test_each_protocol_has_a_video_and_a_place_in_the_report(
    scored: dict[str, dict], root: Path, experiments: dict[str, Experiment]
) -> None:
    run_dir = root / "runs" / "held"
    for name, frames in (("self_reenactment", 8), ("self_reenactment_sequence", 16), ("novel_view", 16)):
        assert probe_video(run_dir / "videos" / f"{name}.mp4").frames == frames
    page = (run_dir / "report.html").read_text()
    assert page.count("<video") == 4, "the film of the avatar comes first"
    assert page.count('src="data:video/mp4;base64,') == 4
    assert 'href="videos/novel_view.mp4"' in page
    assert "16 of 40 frames" in page
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
    sizes = [
        picture.shape for picture in match_sizes(iter([np.zeros((8, 9, 3), np.uint8), np.zeros((20, 4, 3), np.uint8)]))
    ]
    assert sizes == [(8, 9, 3)] * 2


def test_evaluation_goes_on_where_it_was(
    root: Path, scored: dict[str, dict], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
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
    with pytest.raises(KeyboardInterrupt):
        evaluate(run_dir, [folder], quick)
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
    text = comparison_text(comparison, bold=True)
    assert f"\x1b[1m{figures['longer']:.2f}\x1b[0m" in text
    plain = comparison_text(comparison)
    assert re.sub(r"\x1b\[\d*m", "", text) == plain
    lines = [line for line in plain.splitlines() if "." in line and "held-out" not in line]
    assert len({line.index(".") for line in lines}) == 1, "columns must line up"
    names = [line.split("  ")[0] for line in lines]
    dark = ["short, over dark blue", "longer, over dark blue"]
    assert names == ["short", "longer", "mean training picture", "coloured mesh", *dark]


@pytest.mark.parametrize("other_in", ["mask", "edges"])
def test_comparison_warns_of_other_frames_masks_and_missing_runs(
    scored: dict[str, dict], root: Path, tmp_path: Path, other_in: str
) -> None:
    content = read_metrics(root / "runs" / "short")
    entry = content["protocols"]["self_reenactment"]
    if other_in == "mask":
        entry["scored_on"]["talk"]["mask"] = "another"
    else:
        entry["edges"] = "filmed"
    other = tmp_path / "other"
    other.mkdir()
    write_json(other / "metrics.json", "mien.metrics", 1, content)
    (other / "config.json").write_text((root / "runs" / "short" / "config.json").read_text())
    comparison = compare_runs({"short": root / "runs" / "short", "other": other, "never": tmp_path / "never"})
    assert len(comparison.tables) == 2
    warnings = "\n".join(comparison.warnings)
    if other_in == "mask":
        assert "because they were scored on other frames, pictures or masks: short | other" in warnings
    else:
        assert "because they were scored on other soft edges: short (cleaned) | other (filmed); score them" in warnings
        assert [table.edges for table in comparison.tables] == ["cleaned", "filmed"]
        assert "blocks, soft edges as filmed)" in comparison_text(comparison)
    assert "never: was not evaluated" in warnings
    with pytest.raises(UserError, match="no evaluated run"):
        compare_runs({"never": tmp_path / "never"})


def test_compare_command(scored: dict[str, dict], root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(root), "--compare", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["format"], printed["version"]) == ("mien.comparison", 1)
    tables = {(table["protocol"], len(table["rows"])) for table in printed["tables"]}
    assert ("novel_view", 4) in tables
    page = (root / "compare.html").read_text()
    assert "http" not in page
    shown = sum(len({row["run"] for row in t["rows"] if "run" in row}) for t in printed["tables"])
    assert page.count('alt="rendering"') == page.count('alt="error"') == 5 * shown
    assert page.count('alt="truth"') == 5 * len(printed["tables"])
    assert main(["evaluate", str(root), str(root / "runs" / "none"), "--compare"]) == 2


def test_closing_lines_say_what_each_figure_is_of(scored: dict[str, dict]) -> None:
    entry = scored["held"]["protocols"]["novel_view"]
    first, *lines = protocol_lines("novel_view", entry)
    assert first.endswith("novel_view (cameras, 16 frames): PSNR of the whole frame / of the head crop")
    mesh, dark = entry["baselines"]["mesh"], entry["over_dark"]
    rows = {"avatar, faces as tracked": entry, "avatar, over dark blue": dark, "coloured mesh": mesh}
    for words, figures in rows.items():
        wanted = rf"  {words} +{figures['psnr']:.2f} / {figures['head']['psnr']:.2f} dB"
        assert any(re.fullmatch(wanted, line) for line in lines), words
    assert max(map(len, lines)) < 120


def test_frames_are_scored_at_eight_bits(experiments: dict[str, Experiment]) -> None:
    few = replace(experiments["novel_view"], held_out_frames=(Frame(0, 3, 1),))
    row = evaluate_frames(few, EvaluationSettings(perceptual=False, baselines=False)).scores["avatar"][0]
    levels = row["l1"] * 255 * target_image(few, Frame(0, 3, 1)).numel()
    assert levels == pytest.approx(round(levels), abs=0.05), "differences of 8-bit pictures are whole levels"
