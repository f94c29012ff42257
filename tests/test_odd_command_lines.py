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
from mien.cli import main
from mien.commands.stages.names import doubled_videos
from mien.tracking import TrackingSettings, read_tracking
from mien.workspace import Workspace
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace

SKEWED = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": (2 * np.eye(4)).tolist(), "width": 32, "height": 32}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """Return a folder with a space and an umlaut in its name, a workspace W, and odd files."""
    place = tmp_path_factory.mktemp("Köpfe und Leute")
    shutil.copytree(toy_workspace(made_once), place / "W")
    for name in ("empty.csv", "empty.mp4"):
        (place / name).write_bytes(b"")
    (place / "text.txt").write_text("Dear reader")
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
    ("render W --out a.png --size 1e3", "--size"),
    ("render W --out a.txt", "cannot write .txt; use .png"),
    ("render W --out text.txt/a.png", "text.txt is a file, not a folder"),
    ("render W --out folder.png", "is a folder, but a file is to be written there"),
    ("render W --out link/a.png", "is a link to nowhere"),
    ("render W --out /proc/a.png", "cannot be written"),
    (f"render W --out {'a' * 300}.png", "cannot be written"),
    ("render W --out a.mp4 --background transparent", "an .mp4 cannot be transparent"),
    ("render W --out a.png --background #12", "--background #12"),
    ("render W --out a.mp4 --fps nan", "--fps nan"),
    ("render W --out a.mp4 --path loop", "'loop'"),
    ("render W --out a.png --set drop=nan", "--set drop=nan: drop goes from 0 to 1"),
    ("render W --out a.png --set drop=0,5", "'0,5' is not a number"),
    ("render W --out a.png --set drop 0.5", "--set drop 0.5: write drop=0.5"),
    ("render W --out a.png --set dorp=1", "did you mean drop?"),
    ("render W --out a.png --run ../toy", "no run '../toy'; there are: toy"),
    ("render W --out a.png --sequence a/b", "no sequence 'a/b'; there are: clip"),
    ("render W --out a.png --cameras none.json", "none.json: no such file"),
    ("render W --out a.png --cameras cameras.json", "viewmat is not a rotation"),
    ("render W --out a.png --yaw 200", "--yaw 200: give degrees between -180 and 180"),
    ("render W --out a.png --sheet filmed --strength nan", "--strength nan: give a number from 0 to 3"),
    ("render W/runs/toy --out a.png", "did you mean W --run toy?"),
    ("render 'not there' --out a.png", "--out 'not there'`"),
    ("drive W --by none.csv --out a.mp4", "none.csv: no such file or folder"),
    ("drive W --by empty.csv --out a.mp4", "empty.csv: has no frames"),
    ("drive W --by W --out a.png", "one picture"),
    ("drive W --by W --out a.mp4 --fps 30", "--fps 30: is for the times of a .csv"),
    ("drive W --by empty.csv --out a.mp4 --fps 0", "--fps 0"),
    ("drive W --by list.json --out a.mp4 --sequence clip", "--sequence clip"),
    ("view W --port -1", "--port -1: give a number from 1 to 65535"),
    ("view W --host 256.1.1.1", "--host 256.1.1.1: is no address of this machine"),
    ("export W --out a.obj", "cannot write .obj; use .mien, .html, .packed, .glb, .vrm, .ply, .spz, .sog,"),
    ("export W --out a.ply --series none", "--series none: no such sequence, file or folder; "),
    ("evaluate", "nothing to evaluate"),
    ("evaluate W W", "2 workspaces"),
    ("evaluate W --perceptual-frames -1", "--perceptual-frames -1"),
    ("train W --run a/b", "'a/b' cannot be the name of a folder"),
    ("track W --face-model none", "no face model 'none'"),
    ("track W --tracking.paper.rates.focal nan", "--tracking.paper.rates.focal nan: give a number from 0 to 1e+09"),
    ("track W --scoring.cut line", "give --scoring.cut plane, or delete that folder"),
    ("capture empty.mp4 --out text.txt", "is a file, but a folder"),
    ("capture /dev/null --out new", "/dev/null: is not a file"),
    ("create empty.mp4 --out new --capture.landmarks none.csv", "--capture.landmarks none.csv: no such file"),
    ("demo --out new --seconds nan", "--seconds nan"),
]


@pytest.mark.parametrize(("line", "words"), ODD, ids=[line[:60] for line, _ in ODD])
def test_odd_command_lines_are_told_in_one_line(line: str, words: str, place: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    assert main(shlex.split(line)) == 2
    told = [text for text in capsys.readouterr().err.splitlines() if text.strip()]
    assert len(told) == 1, told
    assert told[0].startswith("mien: ")
    assert words in told[0]
    assert sorted(place.rglob("*")) == before


def test_a_current_tracking_and_landmarks_of_no_face_are_said(place: Path, monkeypatch, capsys) -> None:
    """The landmarks of the toy capture are all at one point."""
    monkeypatch.chdir(place)
    assert "no face fits the landmarks" in complaint(capsys, "track", "W", "--again")
    current = {"clip": read_tracking(place / "W/sequences/clip/tracking")}
    monkeypatch.setattr("mien.commands.stages.tracking._current_trackings", lambda *_, **__: current)
    monkeypatch.setattr("mien.commands.stages.tracking.show_tracking", lambda *_: None)
    assert main(["track", "W"]) == 0
    assert "clip: the tracking is current, nothing to do" in capsys.readouterr().err


def test_the_same_video_twice_is_warned_of(place: Path) -> None:
    videos = [place / "text.txt", place / "copy.txt", place / "empty.csv"]
    videos[1].write_bytes(videos[0].read_bytes())
    names, both = ["a", "b", "c"], "a and b are the same video"
    assert list(doubled_videos(videos, names, ())) == [f"{both}, which then counts twice and adds nothing"]
    (warning,) = doubled_videos(videos, names, ("b-1",))
    assert warning == f"{both}: b is held out, but a trains on its frames"
    assert list(doubled_videos(videos[1:], names[1:], ())) == []


def test_an_avatar_of_another_version_says_train_again(place: Path, tmp_path: Path, capsys) -> None:
    changes: dict[str, Callable[[dict[str, Any]], object]] = {
        "version 2, expected 'mien.avatar' version 1": lambda content: content.update(version=2),
        "lacks ['photometric']": lambda content: content["config"].pop("photometric"),
        "unknown entries ['future']": lambda content: content.update(tensors_sha256="0", future=1),
    }
    shutil.copytree(place / "W", tmp_path / "W")
    path = tmp_path / "W/runs/toy/avatar/avatar.json"
    whole = path.read_bytes()
    for words, change in changes.items():
        path.write_bytes(whole)
        edit_json(path, change)
        told = complaint(capsys, "render", str(tmp_path / "W"), "--out", str(tmp_path / "a.png"))
        assert words in told
        assert "train it again" in told


@pytest.mark.parametrize("value", ["-3", "0", "nan", "inf"])
def test_a_senseless_focal_length_is_refused_before_work(value: str) -> None:
    refuses(f"--tracking.focal {value}: give the focal length in pixels", TrackingSettings(focal=float(value)).check)


def test_unfinished_and_compared_runs_do_not_ask_for_a_name(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    for run in ("good", "stopped"):
        workspace.run_dir(run).mkdir(parents=True)
        (workspace.run_dir(run) / "config.json").touch()
    refuses("has several runs", workspace.pick_run, None)
    (workspace.run_dir("good") / "avatar").mkdir()
    shutil.copytree(workspace.run_dir("good"), workspace.run_dir("compare-headgas-4min"))
    assert workspace.pick_run(None) == "good"
    for named in ("stopped", "compare-headgas-4min"):
        assert workspace.pick_run(named) == named
    for run in ("good", "stopped"):
        shutil.rmtree(workspace.run_dir(run))
    assert workspace.pick_run(None) == "compare-headgas-4min"
