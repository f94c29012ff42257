"""A stranger's workspace is refused if its files do not fit together; single values are in `fuzzing.values`."""

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from capture_helpers import write_gradient_video
from damage import edit_json
from fuzzing.material import new_avatar
from mien.avatar import METHODS, load_avatar, write_avatar
from mien.capture import read_capture
from mien.cli import main
from mien.errors import UserError
from mien.evaluation import EvaluationSettings, evaluate
from mien.face.loading import read_landmarks
from mien.storage import file_digest, read_json, read_tensors, write_json, write_tensors
from mien.tracking import TrackingSettings, pipeline, read_scoring, read_tracking, track_subject
from mien.training import read_sequence
from shared_things import MadeOnce, evaluated_workspace
from toy_scene import toy_face_model

HUGE = 10**400


@pytest.fixture
def made(made_once: MadeOnce) -> Path:
    return evaluated_workspace(made_once)


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "received", copy_function=shutil.copy2)


def test_partial_figures_of_other_kinds_are_dropped(workspace: Path) -> None:
    """Partial figures with impossible content are dropped, although their first line is right."""
    run, clip = workspace / "runs/toy", workspace / "sequences/clip"
    settings = EvaluationSettings(perceptual=False, video_frames=0)
    fingerprint = next(iter(json.loads((run / "metrics.json").read_text())["fingerprints"].values()))
    for line in (
        '{"frame": [0, 4, 0], "scores": {}, "seconds": 1}',
        '{"frame": [0, 4, 0], "scores": {"avatar": {"psnr": "high"}}, "seconds": 1}',
        '{"frame": [0, 4, 0], "scores": [], "seconds": 1}',
        f'{{"frame": [0, {HUGE}, 0], "scores": {{}}, "seconds": 1}}',
        "[" * 5000,
    ):
        (run / ".self_reenactment_tail.partial").write_text(f'{{"scores_of": "{fingerprint}"}}\n{line}\n')
        assert evaluate(run, [clip], settings)["protocols"]["self_reenactment_tail"]["psnr"] > 0


def test_a_picture_larger_than_it_should_be_is_not_decoded(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture larger than it should be is not decoded. Its header claims 30,000 x 30,000 pixels."""
    folder = workspace / "sequences/clip"
    decoded: list[object] = []
    monkeypatch.setattr("mien.picture_files.cv2.imdecode", lambda *arguments: decoded.append(arguments))
    shutil.rmtree(folder / "capture/cache")
    for file, read in (
        (folder / "capture/frames/front/000000.png", lambda: read_capture(folder / "capture")),
        (folder / "scoring/masks/00/000000.png", lambda: read_scoring(folder / "scoring")),
    ):
        data = bytearray(file.read_bytes())
        data[16:24] = (30000).to_bytes(4, "big") * 2
        file.write_bytes(data)
        with pytest.raises(UserError, match="damaged, or not of 32x32 pixels"):
            read()
    assert decoded == []
    assert not (folder / "capture/cache/frames.u8").exists()


def rewrite_tracking(folder: Path, change: Callable[[dict[str, Tensor]], object]) -> None:
    tensors = read_tensors(folder / "tracking.safetensors")
    change(tensors)
    write_tensors(folder / "tracking.safetensors", tensors)
    digest = file_digest(folder / "tracking.safetensors")
    edit_json(folder / "tracking.json", lambda content: content.update(tensors_sha256=digest))


def test_parts_of_a_sequence_have_to_be_of_the_same_pictures(workspace: Path) -> None:
    clip = workspace / "sequences/clip"

    def shorten(tensors: dict[str, Tensor]) -> None:
        per_timestep = ("expression", "joints", "head_rotation", "head_translation", "valid", "neck_lines", "residuals")
        tensors.update({name: tensors[name][:3].clone() for name in per_timestep})

    rewrite_tracking(clip / "tracking", shorten)
    read_tracking(clip / "tracking")
    with pytest.raises(UserError, match="other pictures than the capture"):
        read_sequence(clip)


def test_a_chosen_number_of_parts_is_not_counted_to(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A capture may claim to be part of 10^12 parts. The command does not look for each of them."""
    write_gradient_video(tmp_path / "clip.mp4")
    for name in ("clip", "clip-1"):
        capture = workspace / "sequences" / name / "capture"
        if not capture.exists():
            shutil.copytree(workspace / "sequences/clip/capture", capture)
        edit_json(capture / "capture.json", lambda c: c.update(source={"part": {"count": 10**12}}))
    began = time.monotonic()
    assert main(["capture", str(tmp_path / "clip.mp4"), "--out", str(workspace)]) == 2
    assert time.monotonic() - began < 30
    assert "holds a capture of another source" in capsys.readouterr().err


def test_json_is_written_as_it_is_read(tmp_path: Path) -> None:
    """Tuples, numeric keys and large whole numbers have the same checksum when json is written and read."""
    content = {"a": (1, 2.5, [2**63 - 1]), "b": {"1": None}}
    write_json(tmp_path / "a.json", "x", 1, {**content, "b": {1: None}})
    assert read_json(tmp_path / "a.json", "x", 1)["a"] == [1, 2.5, [2**63 - 1]]


def test_kept_pieces_of_a_tracking_that_are_of_no_use(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tracking starts again, once, if the kept files are whole but hold something else."""
    keep, seen = tmp_path / ".tracking-0123", []
    keep.mkdir()

    def fit(captures: object, model: object, settings: object, keep: Path, *others: object) -> list[object]:
        seen.append(keep.exists())
        if keep.exists():
            raise KeyError("rows")
        return []

    monkeypatch.setattr(pipeline, "track_once", fit)
    capture = read_capture(workspace / "sequences" / "clip" / "capture")
    arguments: Any = ([capture], toy_face_model(), TrackingSettings(), keep, None)
    assert track_subject(*arguments) == []
    assert seen == [True, False]
    assert "starts again" in capsys.readouterr().err
    monkeypatch.setattr(pipeline, "track_once", lambda *_: {}["a bug of ours"])
    with pytest.raises(KeyError):
        track_subject(*arguments)


@pytest.mark.parametrize("method", [name for name, one in METHODS.items() if hasattr(one.config, "points")])
def test_what_counts_only_at_the_beginning_takes_no_memory(method: str, tmp_path: Path) -> None:
    """Settings that only matter at the start take no memory. The avatar has the points of its tensors."""
    write_avatar(tmp_path / "avatar", new_avatar(method))
    expected = load_avatar(tmp_path)
    edit_json(tmp_path / "avatar/avatar.json", lambda content: content["config"].update(points=1_000_000))
    found = load_avatar(tmp_path)
    assert found.config.points == 1_000_000  # pyright: ignore[reportAttributeAccessIssue]
    posed = [avatar.pose(avatar.subject).gaussians.means for avatar in (found, expected)]
    assert torch.equal(*posed)


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a\0b", ""])
def test_landmarks_of_a_name_that_leads_elsewhere(name: str) -> None:
    with pytest.raises(UserError, match="cannot be the name of a face model"):
        read_landmarks(name, toy_face_model())
