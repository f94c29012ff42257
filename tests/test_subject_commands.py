"""Several videos of one person are captured apart, and tracked and trained together, on the command line."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.avatar.methods import DEFAULT_METHOD
from mien.cli import main
from mien.lab.synthetic.captures import write_synthetic_video
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.media.video import read_video_frames, write_video
from mien.tracking import read_tracking
from refusals import complaint

pytestmark = pytest.mark.unchecked
TRACKING = ("--tracking.keyframes", "3", "--tracking.schedule", "landmarks")
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""
TRAINING = ("--steps", "2", "--preset", "draft", *PLAIN)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("clips")
    recipe = SyntheticRecipe(width=128, height=128, seconds=0.9, fps=10.0, supersample=1, texture_size=128, hair="none")
    write_synthetic_video(recipe, folder / "whole.mp4", 3)
    frames = [image for _, image in read_video_frames(folder / "whole.mp4")]
    for index, name in enumerate(("one", "two", "three")):
        write_video(folder / f"{name}.mp4", iter(frames[3 * index : 3 * index + 3]), 10.0)
    return {path.stem: path for path in folder.iterdir()}


@pytest.fixture(scope="module")
def made(clips: dict[str, Path], short_films: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("subject") / "out"
    assert main(creating(clips, folder)) == 0
    return folder


workspace = pytest.fixture(lambda made, tmp_path: Path(shutil.copytree(made, tmp_path / "W")))


def creating(clips: dict[str, Path], folder: Path) -> list[str]:
    arguments = ["create", str(clips["one"]), str(clips["two"]), "--out", str(folder), "--hold-out", "two"]
    return [*arguments, "--split", "none", "--capture.size", "128", "--capture.no-cuts", *TRAINING, *TRACKING]


def _identity(workspace: Path, name: str) -> torch.Tensor:
    return read_tracking(workspace / "sequences" / name / "tracking").face.identity.clone()  # not a map of the file


def _config(workspace: Path, run: str = DEFAULT_METHOD) -> dict:
    return json.loads((workspace / "runs" / run / "config.json").read_text())


def test_two_clips_make_one_avatar_and_the_same_command_does_nothing_again(workspace: Path, clips, capsys) -> None:
    assert torch.equal(_identity(workspace, "one"), _identity(workspace, "two"))
    assert [entry["sequence"] for entry in _config(workspace)["data"]] == ["one", "two"]
    assert _config(workspace)["settings"]["held_out_sequences"] == ["two"]
    metrics = json.loads((workspace / "runs" / DEFAULT_METHOD / "metrics.json").read_text())
    assert sum(entry["frames"] for entry in metrics["protocols"].values()) == 3
    assert all((workspace / f"sequences/{name}/tracking/overlay.mp4").is_file() for name in ("one", "two"))
    before = {path: path.stat().st_mtime_ns for path in workspace.rglob("*.safetensors")}
    assert main(creating(clips, workspace)) == 0
    assert "Tracking" not in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in workspace.rglob("*.safetensors")} == before
    # A damaged tracking is made again.
    before = _identity(workspace, "two")
    (workspace / "sequences/two/tracking/tracking.safetensors").write_bytes(b"broken")
    assert main(["track", str(workspace), *TRACKING]) == 0
    assert "tracking again" in capsys.readouterr().err
    assert torch.equal(_identity(workspace, "two"), before)


def test_a_third_clip_gives_all_a_new_identity(workspace: Path, clips: dict[str, Path], capsys) -> None:
    before, arguments = _identity(workspace, "one"), ["--capture.size", "128", "--capture.no-cuts"]
    assert main(["capture", str(clips["three"]), "--out", str(workspace), *arguments]) == 0
    assert main(["track", str(workspace), *TRACKING]) == 0
    shown = capsys.readouterr().err
    assert "three added: all 3 sequences are tracked again" in shown
    assert f"Trained on the previous tracking: {DEFAULT_METHOD}" in shown
    assert torch.equal(_identity(workspace, "one"), _identity(workspace, "three"))
    assert not torch.equal(_identity(workspace, "one"), before)
    assert "tracked again after this run was trained" in complaint(capsys, "evaluate", str(workspace))
    train = ["train", str(workspace), *TRAINING]
    assert f"{DEFAULT_METHOD}: holds a run with other settings" in complaint(capsys, *train)
    assert main([*train, "--run", "all"]) == 0
    assert [entry["sequence"] for entry in _config(workspace, "all")["data"]] == ["one", "three", "two"]
    assert main([*train, "--run", "some", "--sequences", "one", "--hold-out", "three"]) == 0
    assert [entry["sequence"] for entry in _config(workspace, "some")["data"]] == ["one", "three"]
    assert main([*train, "--run", "some", "--hold-out", "three"]) == 2
    assert "was trained on one, three, not on one, three, two" in capsys.readouterr().err


def test_mistakes_are_told_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip, out = tmp_path / "clip.mp4", tmp_path / "out"
    write_video(clip, [np.zeros((16, 16, 3), np.uint8)] * 2, 25.0)
    (out / "runs" / "other").mkdir(parents=True)
    content = {
        "format": "mien.run", "version": 1, "method": {"kind": "other"}, "settings": {"split": "none"},
        "data": [{"sequence": "clip"}], "mien": "0", "command_line": [],
    }  # fmt: skip
    (out / "runs" / "other" / "config.json").write_text(json.dumps(content))
    for arguments, told in (
        ([], "no video"),
        ([clip, tmp_path / "gone.mp4"], "no such video"),
        ([clip, clip], "two videos would both be the sequence 'clip'"),
        ([clip, "--name", "a", "b"], "2 names, but the number of videos is 1"),
        ([clip, "--face-model", "any"], "no face model 'any'"),
        ([clip, "--run", "other"], "holds a run with other"),
    ):
        assert told in complaint(capsys, "create", "--out", out, *arguments)
        assert not (out / "sequences").exists()
