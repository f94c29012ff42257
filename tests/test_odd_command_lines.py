"""Mistyped commands end with one line that names the value and the remedy, exit code 2, and nothing written."""

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from damage import edit_json
from mien.capture.video import write_video
from mien.cli import main
from mien.commands.stages.names import doubled_videos
from mien.errors import UserError
from mien.tracking import TrackingSettings, read_tracking
from mien.workspace import Workspace
from shared_things import MadeOnce, toy_workspace

CAMERA = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 32, "height": 32}
SKEWED = {**CAMERA, "viewmat": (2 * np.eye(4)).tolist()}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """Return a folder with a space and an umlaut in its name, a workspace W, and odd files."""
    place = tmp_path_factory.mktemp("Köpfe und Leute")
    shutil.copytree(toy_workspace(made_once), place / "W")
    for name in ("empty.csv", "empty.json", "empty.mp4"):
        (place / name).write_bytes(b"")
    (place / "text.txt").write_text("Dear reader")
    write_video(place / "short.mp4", [np.zeros((16, 16, 3), np.uint8)] * 2, 25.0)
    (place / "bytes.csv").write_bytes(bytes(range(256)))
    (place / "list.json").write_text("[]")
    (place / "cameras.json").write_text(json.dumps({"format": "mien.cameras", "version": 1, "cameras": [SKEWED]}))
    (place / "folder.png").mkdir()
    (place / "link").symlink_to("/nowhere")
    return place


ODD = [
    ("rendr W --out a.png", "did you mean render?"),
    ("--helpp", "did you mean --help?"),
    ("render W --out ''", "argument 3 after render is empty"),
    ("render W --out a.png --width 0", "--width 0 --height 512: give numbers from 16 to 8192"),
    ("render W --out a.png --width 8193", "--width 8193 --height 512"),
    ("render W --out a.png --height -1", "--height -1"),
    ("render W --out a.png --size 1e3", "--size"),
    ("render W --out a.txt", "cannot write .txt; use .png"),
    ("render W --out text.txt/a.png", "text.txt is a file, not a folder"),
    ("render W --out folder.png", "is a folder, but a file is to be written there"),
    ("render W --out link/a.png", "is a link to nowhere"),
    ("render W --out /proc/a.png", "cannot be written"),
    ("render W --out /dev/null", "is a file, but a folder"),
    (f"render W --out {'a' * 300}.png", "cannot be written"),
    ("render W --out a.mp4 --background transparent", "an .mp4 cannot be transparent"),
    ("render W --out a.png --background #12", "--background #12"),
    ("render W --out a.mp4 --frames 0", "--frames 0: give 1 or more"),
    ("render W --out a.mp4 --fps nan", "--fps nan"),
    ("render W --out a.mp4 --zoom 0", "--zoom 0: give a number from 0.01 to 100"),
    ("render W --out a.mp4 --span inf", "--span inf"),
    ("render W --out a.mp4 --path loop", "'loop'"),
    ("render W --out a.png --set drop=nan", "--set drop=nan: drop goes from 0 to 1"),
    ("render W --out a.png --set drop=1e300", "--set drop=1e300"),
    ("render W --out a.png --set drop=0,5", "'0,5' is not a number"),
    ("render W --out a.png --set drop 0.5", "--set drop 0.5: write drop=0.5"),
    ("render W --out a.png --set drop", "--set drop: write drop=0.6"),
    ("render W --out a.png --set dorp=1", "did you mean drop?"),
    ("render W --out a.png --run ../toy", "no run '../toy'; there are: toy"),
    ("render W --out a.png --sequence a/b", "no sequence 'a/b'; there are: clip"),
    ("render W --out a.png --cameras none.json", "none.json: no such file"),
    ("render W --out a.png --cameras empty.json", "cannot be read as json"),
    ("render W --out a.png --cameras cameras.json", "viewmat is not a rotation"),
    ("render W --out a.png --yaw 200", "--yaw 200: give degrees between -180 and 180"),
    ("render W --out a.png --pitch nan", "--pitch nan: give degrees between -89 and 89"),
    ("render W --out a.png --yaw 30 --path captured", "leave out --path captured"),
    ("render W --out a.mp4 --sheet expressions", "a sheet is one picture; give --out NAME.png"),
    ("render W --out a.png --sheet smiles", "'smiles'"),
    ("render W --out a.png --sheet filmed --strength 4", "--strength 4: give a number from 0 to 3"),
    ("render W --out a.png --sheet filmed --strength nan", "--strength nan: give a number from 0 to 3"),
    ("render W --out a.png --sheet filmed --background transparent", "a sheet has no transparency"),
    ("render W --out a.png --sheet turntable --own-motion", "leave out --own-motion"),
    ("render W --out a.png --sheet turntable --cameras cameras.json", "leave out --cameras"),
    ("render W/runs/toy --out a.png", "did you mean W --run toy?"),
    ("render 'not there' --out a.png", "--out 'not there'`"),
    ("render text.txt --out a.png", "text.txt: is a file; give"),
    ("drive W --by none.csv --out a.mp4", "none.csv: no such file or folder"),
    ("drive W --by empty.csv --out a.mp4", "empty.csv: has no frames"),
    ("drive W --by bytes.csv --out a.mp4", "bytes.csv: cannot be read as csv"),
    ("drive W --by empty.json --out a.mp4", "empty.json: cannot be read as json"),
    ("drive W --by list.json --out a.mp4", "list.json: is not a list of frames"),
    ("drive W --by empty.mp4 --out a.mp4", "empty.mp4: is empty"),
    ("drive W --by text.txt --out a.mp4", "text.txt: cannot be read as a video"),
    ("drive W --by folder.png --out a.mp4", "not a mien workspace"),
    ("drive W --by W --out a.png", "one picture"),
    ("drive W --by W --out a.mp4 --fps 30", "--fps 30: is for the timecode of a .csv"),
    ("drive W --by empty.csv --out a.mp4 --fps 0", "--fps 0"),
    ("drive W --by list.json --out a.mp4 --sequence clip", "--sequence clip"),
    ("view none", "none: no such folder"),
    ("view text.txt", "text.txt: is no .mien file"),
    ("view W --port -1", "--port -1: give a number from 1 to 65535"),
    ("view W --play none", "none: no such file or folder"),
    ("view W --host 256.1.1.1", "--host 256.1.1.1: is no address of this machine"),
    ("export W --out a.obj", "cannot write .obj; use .mien, .html, .packed, .glb, .vrm, .ply, .spz, .sog,"),
    ("export W --out a.mien --set drop=1", "leave --set and --series out"),
    ("export W --out a.mien --every 3", "--every 3"),
    ("export W --out a.ply --series none", "--series none: no such sequence, file or folder; "),
    ("evaluate", "nothing to evaluate"),
    ("evaluate W W", "2 workspaces"),
    ("evaluate W --perceptual-frames -1", "--perceptual-frames -1"),
    ("evaluate --images W", "belong together"),
    ("evaluate W --compare", "no evaluated run to compare"),
    ("train W --run a/b", "'a/b' cannot be the name of a folder"),
    ("train W --hold-out none", "--hold-out none: no such sequence"),
    ("train W --hold-out clip", "leaves no sequence to train on"),
    ("track W --face-model none", "no face model 'none'"),
    ("track W --tracking.photometric.sizes 0", "--tracking.photometric.sizes 0: give numbers from 16 to 8192"),
    ("track W --tracking.photometric.sizes", "--tracking.photometric.sizes (nothing)"),
    ("track W --tracking.photometric.focal-sigma 0", "--tracking.photometric.focal-sigma 0: give a number above 0"),
    ("track W --tracking.paper.shrink 0", "--tracking.paper.shrink 0"),
    ("track W --tracking.paper.epochs -1", "--tracking.paper.epochs -1"),
    ("track W --tracking.paper.rates.focal nan", "--tracking.paper.rates.focal nan: give a number from 0 to 1e+09"),
    ("track W --tracking.smoothness.rotation -1", "--tracking.smoothness.rotation -1: give a number above 0, or inf"),
    ("track W --scoring.cut line", "give --scoring.cut plane, or delete that folder"),
    ("track W --scoring.cut circle", "'circle'"),
    ("create short.mp4 --out W --name clip --scoring.cut line", "give --scoring.cut plane, or delete that folder"),
    ("capture empty.mp4 --out text.txt", "is a file, but a folder"),
    ("capture /dev/null --out new", "/dev/null: is not a file"),
    ("create empty.mp4 --out new --capture.size 0", "--capture.size 0"),
    ("create empty.mp4 --out new --capture.landmarks none.csv", "--capture.landmarks none.csv: no such file"),
    ("demo --out text.txt", "text.txt: is a file"),
    ("demo --out new --seconds nan", "--seconds nan"),
    ("demo --out new --seconds -3", "--seconds -3"),
]


@pytest.mark.parametrize(("line", "words"), ODD, ids=[line[:60] for line, _ in ODD])
def test_odd_command_lines_are_told_in_one_line(
    line: str, words: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    assert main(shlex.split(line)) == 2
    told = [text for text in capsys.readouterr().err.splitlines() if text.strip()]
    assert len(told) == 1, told
    assert told[0].startswith("mien: ")
    assert words in told[0]
    assert sorted(place.rglob("*")) == before


def test_a_current_tracking_is_said(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    current = {"clip": read_tracking(place / "W/sequences/clip/tracking")}
    monkeypatch.setattr("mien.commands.stages.tracking._current_trackings", lambda *_, **__: current)
    monkeypatch.setattr("mien.commands.stages.tracking.show_tracking", lambda *_: None)
    assert main(["track", "W"]) == 0
    assert "clip: the tracking is current, nothing to do" in capsys.readouterr().err


def test_the_same_video_twice_is_warned_of(place: Path) -> None:
    videos = [place / "text.txt", place / "copy.txt", place / "bytes.csv"]
    videos[1].write_bytes(videos[0].read_bytes())
    names = ["a", "b", "c"]
    assert list(doubled_videos(videos, names, ())) == [
        "a and b are the same video, which then counts twice and adds nothing"
    ]
    (warning,) = doubled_videos(videos, names, ("b-1",))
    assert warning == "a and b are the same video: b is held out, but a trains on its frames"
    assert list(doubled_videos(videos[1:], names[1:], ())) == []


def test_landmarks_that_no_face_could_have(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of the toy capture are all at one point."""
    monkeypatch.chdir(place)
    assert main(["track", "W", "--again"]) == 2
    assert "no face fits the landmarks" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(version=0), "version 0, expected 'mien.avatar' version 1"),
        (lambda content: content.update(version=2), "version 2, expected 'mien.avatar' version 1"),
        (lambda content: content.pop("tensors_sha256"), "lacks ['tensors_sha256'] (made by another version of mien?)"),
        (lambda content: content.pop("config"), "lacks ['config'] (made by another version of mien?)"),
        (lambda content: content["config"].pop("photometric"), "lacks ['photometric']"),
        (lambda content: content.update(tensors_sha256="0", future=1), "unknown entries ['future']"),
    ],
)
def test_an_avatar_of_another_version_says_train_again(
    change: Callable[[dict[str, Any]], object], words: str, place: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    shutil.copytree(place / "W", tmp_path / "W")
    edit_json(tmp_path / "W/runs/toy/avatar/avatar.json", change)
    assert main(["render", str(tmp_path / "W"), "--out", str(tmp_path / "a.png")]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "train it again" in told


def test_a_name_with_umlauts_is_written(place: Path, tmp_path: Path) -> None:
    assert main(["render", str(place / "W"), "--out", str(tmp_path / "größer.png"), "--size", "16"]) == 0
    assert (tmp_path / "größer.png").is_file()


@pytest.mark.parametrize("value", ["-3", "0", "nan", "inf"])
def test_a_senseless_focal_length_is_refused_before_work(tmp_path: Path, value: str):
    with pytest.raises(UserError, match=f"--tracking.focal {value}: give the focal length in pixels"):
        TrackingSettings(focal=float(value)).check()


def test_an_unfinished_run_does_not_ask_for_its_name(tmp_path: Path):
    workspace = Workspace(tmp_path)
    for run in ("good", "stopped"):
        workspace.run_dir(run).mkdir(parents=True)
        (workspace.run_dir(run) / "config.json").touch()
    with pytest.raises(UserError, match="has several runs"):
        workspace.pick_run(None)
    (workspace.run_dir("good") / "avatar").mkdir()
    assert workspace.pick_run(None) == "good"
    assert workspace.pick_run("stopped") == "stopped"


def test_compared_runs_do_not_ask_for_a_name(tmp_path: Path):
    workspace = Workspace(tmp_path)
    for run in ("compare-headgas-4min", "good"):
        (workspace.run_dir(run) / "avatar").mkdir(parents=True)
        (workspace.run_dir(run) / "config.json").touch()
    assert workspace.pick_run(None) == "good"
    assert workspace.pick_run("compare-headgas-4min") == "compare-headgas-4min"
    shutil.rmtree(workspace.run_dir("good"))
    assert workspace.pick_run(None) == "compare-headgas-4min"
