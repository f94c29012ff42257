"""The command line: help, exit codes, one-line messages, and remedies that work. test_end_to_end.py has a real run."""

import importlib
import json
import re
import shlex
import shutil
import sys
import wave
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import cv2
import numpy as np
import pytest

from damage import edit_json
from mien.cli import COMMANDS, main
from mien.commands.parsing import explained, with_defaults
from mien.disk.workspace import Workspace
from mien.media.video import write_video
from mien.pipeline.names import doubled_videos
from mien.tracking import read_tracking
from mien.tracking.settings import TrackingSettings
from recordings import live_link_face, plain, table
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace
from test_odd_footage import flat, write_tracks

Told = pytest.CaptureFixture[str]


def help_of(capsys: Told, *arguments: str) -> str:
    with pytest.raises(SystemExit, match="^0$"):
        main(arguments)
    return capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_no_line_breaks_of_the_source_and_no_empty_defaults(name: str, capsys: Told) -> None:
    module = importlib.import_module(f"mien.commands.{name.replace('-', '_')}")
    chosen = {"": module.task_of([])} if name == "drive" else {"": getattr(module, "Command", None)}
    for command in getattr(module, "TASKS", chosen).values():
        hints = get_type_hints(explained(with_defaults(command, []), bool), include_extras=True).values()
        texts = [mark.help for hint in hints for mark in get_args(hint)[1:] if getattr(mark, "help", None)]
        assert texts
        assert not [text for text in texts if "\n" in text]
    shown = help_of(capsys, name, "--help-all")
    assert f"usage: mien {name}" in shown
    assert "default: None)" not in shown
    assert "default: )" not in shown
    assert main(["--help"]) == main(["batch-row", "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"  {name} " in shown
    assert "usage: mien batch-row DIR" in shown


def test_short_help_leaves_details_to_help_all(capsys: Told) -> None:
    shown = help_of(capsys, "create", "--help")
    assert sorted(re.findall(r"^\W*(--[a-z][\w.-]*)", shown, re.MULTILINE)) == [
        "--device", "--method", "--name", "--out", "--preset", "--view",
    ]  # fmt: skip
    assert shown.rstrip().endswith("mien create --method gaussian_avatars --help-all")
    for name, detail in (("capture", "--capture.max-frames"), ("track", "--tracking.photometric.sizes")):
        short, whole = (help_of(capsys, name, flag) for flag in ("--help", "--help-all"))
        assert (detail in whole, detail in short) == (True, False)
        assert ("--tracking.schedule" in short) == (name == "track")


@pytest.mark.parametrize(("arguments", "words"), [
    ("create a.mp4 --uot here", ("Missing from mien create: --out DIR; Unrecognized options: --uot here",)),
    ("train here --training.step 3", ("Unrecognized options: --training.step",)),
    ("create a.mp4 --method headgas --step 3 --out here", ("Unrecognized options: --step, 3",)),
    ("create a.mp4 --out b --tracking.paper.start 3", ("`mien track` has all options of tracking", "see mien create")),
    ("batch-row", ("which `mien batch` starts",)),
    ("render here --out a.mp4 --siez 3", ("--siez", "Perhaps you meant: --size INT; see mien render --help",)),
    ("create", ("--out DIR", "see mien create --help")),
    ("render DIR --out a.png --set jawOpen=1 --set=eyeBlinkLeft=1", ("--set is given twice",)),
    ("demo --out demo --out=", ("--out= is empty",)),  # as a path, the current folder (found by the fuzzer, seed 5)
    ("train here --method.appearance nonsense", ("nonsense", "features", "see mien train --help-all")),
    ("create a.mp4 --out here --steps many", ("--steps", "'many'")),
    ("create none.mp4 --out here --method nerf", ("instead of 'nerf'",)),
    ("track here --tracking.keyframes -1", ("--tracking.keyframes -1",)),
    ("bench nothing", ("nothing", "render, train-step, scaling, quality, compare")),
    ("bench scaling --plot chart.jpg", ("charts are written as .svg",)),
    ("bench train-step --parts --method headgas", ("--parts --method headgas",)),
    ("bench train-step --seconds=0", ("--seconds 0: give a number above 0",)),
    ("bench train-step --method point_avatar", ("point_avatar", "a GPU only; add --device cuda")),
    ("evaluate x --protocol None", ("--protocol", "{insta,imavatar,nersemble", "['None']")),
    ("capture x --out y --capture.turn 45", ("'45'", "'--capture.turn'. Expected one of ('0', '90', '180', '270')")),
])  # fmt: skip
def test_wrong_arguments_are_told_in_one_line(arguments: str, words: tuple[str, ...], tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    message = complaint(capsys, *arguments.split())
    assert all(word in message for word in words), message
    assert not set("│╭╰─") & set(message)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["create", "capture"])
def test_file_that_is_no_video(tmp_path: Path, capsys: Told, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    """It is refused before anything heavy is loaded, so that nobody waits for the answer."""
    monkeypatch.setattr(f"mien.commands.{command}.Command.run", lambda command: pytest.fail("the work began"))
    (tmp_path / "letter.mp4").write_text("Dear reader")
    (tmp_path / "face.mp4").write_bytes(cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes())
    for name, told in (("none.mp4", ""), ("letter.mp4", ""), ("face.mp4", ": is a picture; give a video")):
        assert f"{name}{told}" in complaint(capsys, command, tmp_path / name, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["track", "train", "evaluate", "export --out a.ply", "render --out a.mp4"])
def test_workspace_that_is_not_there(command: str, tmp_path: Path, capsys: Told) -> None:
    name, *out = command.split()
    assert "no such folder" in complaint(capsys, name, tmp_path / "gone", *out)
    assert "not a mien workspace" in complaint(capsys, name, tmp_path, *out)


def test_a_capture_that_is_damaged_or_gone_is_named(tmp_path: Path, capsys: Told) -> None:
    me = tmp_path / "sequences" / "me"
    (me / "tracking").mkdir(parents=True)
    told = complaint(capsys, "track", tmp_path)
    assert "the capture of me is missing" in told
    assert f"mien capture VIDEO --out {tmp_path} --name me" in told
    (me / "capture").mkdir()
    (me / "capture/capture.json").write_text('{"format": "mien.capture", "ver')
    assert re.search("capture.json.*run `mien capture` again", complaint(capsys, "track", tmp_path))


def test_a_bug_keeps_its_traceback_in_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Told) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["mien", "\x1b[2J\udcff"])
    monkeypatch.setattr("mien.disk.workspace.Workspace.sequence_names", lambda self: 1 / 0)
    assert main(["track", str(tmp_path)]) == 1
    shown = capsys.readouterr().err
    assert "bug in mien" in shown
    assert not [word for word in ("Traceback", "\x1b") if word in shown]
    (log,) = tmp_path.glob("mien-crash-*.log")
    assert "ZeroDivisionError" in log.read_text()


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
    ("rendr W --out a.png", "did you mean render?"), ("--helpp", "did you mean --help?"),
    ("render W --out ''", "argument 3 after render is empty"),
    ("render W --out a.png --width 0", "--width 0 --height 512: give numbers from 16 to 8192"),
    ("render W --out a.png --size 1e3", "--size"), ("render W --out a.txt", "cannot write .txt; use .png"),
    ("render W --out text.txt/a.png", "text.txt is a file, not a folder"),
    ("render W --out folder.png", "is a folder, but a file is to be written there"),
    ("render W --out link/a.png", "is a link to nowhere"), ("render W --out /proc/a.png", "cannot be written"),
    (f"render W --out {'a' * 300}.png", "cannot be written"),
    ("render W --out a.mp4 --background transparent", "an .mp4 cannot be transparent"),
    ("render W --out a.png --background #12", "--background #12"),
    ("render W --out a.mp4 --fps nan", "--fps nan"), ("render W --out a.mp4 --path loop", "--path loop: give one of"),
    ("render W --out a.png --set drop=nan", "--set drop=nan: drop goes from 0 to 1"),
    ("render W --out a.png --set drop=0,5", "'0,5' is not a number"),
    ("render W --out a.png --set drop 0.5", "--set drop 0.5: write drop=0.5"),
    ("render W --out a.png --set dorp=1", "did you mean drop?"),
    ("render W --out a.png --run ../toy", "no run '../toy'; there are: toy"),
    ("render W --out a.png --motion a/b", "no sequence 'a/b'; there are: clip"),
    ("render W --out a.png --path none.json", "none.json: no such file"),
    ("render W --out a.png --path cameras.json", "viewmat is not a rotation"),
    ("render W --out a.png --yaw 200", "--yaw 200: give a number from -180 to 180"),
    ("render sheet W filmed --out a.png --strength nan", "--strength nan: give a number from 0 to 3"),
    ("render W/runs/toy --out a.png", "did you mean W --run toy?"),
    ("render 'not there' --out a.png", "--out 'not there'`"),
    ("drive W --by none.csv --out a.mp4", "none.csv: no such file or folder"),
    ("drive W --by empty.csv --out a.mp4", "empty.csv: has no frames"),
    ("drive W --by W --out a.png", "one picture"),
    ("drive W --by W --out a.mp4 --fps 30", "--fps 30: is for the times of a .csv"),
    ("drive W --by empty.csv --out a.mp4 --fps 0", "--fps 0"),
    ("drive W --by list.json --out a.mp4 --sequence clip", "--sequence clip"),
    ("view W --port -1", "--port -1: give a number from 0 to 65535"),
    ("export W --out a.obj", "cannot write .obj; use .mien, .html, .packed, .glb, .vrm, .ply, .spz, .sog,"),
    ("export W --out a.ply --series none", "--series none: no such sequence, file or folder; "),
    ("evaluate", "Missing from mien evaluate: DIR"), ("evaluate W W", "Unrecognized options: W"),
    ("evaluate W --perceptual-frames -1", "--perceptual-frames -1"),
    ("train W --run a/b", "'a/b' cannot be the name of a folder"),
    ("track W --face-model none", "no face model 'none'"),
    ("track W --tracking.photometric.lids nan", "--tracking.photometric.lids nan: give a number from 0 to 1e+09"),
    ("track W --scoring.cut line", "give --scoring.cut plane, or delete that folder"),
    ("capture empty.mp4 --out text.txt", "is a file, but a folder"),
    ("capture /dev/null --out new", "/dev/null: is not a file"),
    ("create empty.mp4 --out new --capture.landmarks none.csv", "--capture.landmarks none.csv: no such file"),
    ("demo --out new --seconds nan", "--seconds nan"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "words"), ODD, ids=[line[:60] for line, _ in ODD])
def test_odd_command_lines_are_told_in_one_line(line: str, words: str, place: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    assert words in complaint(capsys, *shlex.split(line))
    assert sorted(place.rglob("*")) == before


def test_a_current_tracking_and_landmarks_of_no_face_are_said(place: Path, monkeypatch, capsys) -> None:
    """The landmarks of the toy capture are all at one point."""
    monkeypatch.chdir(place)
    assert "no face fits the landmarks" in complaint(capsys, "track", "W", "--again")
    current = {"clip": read_tracking(place / "W/sequences/clip/tracking")}
    monkeypatch.setattr("mien.pipeline.track._current_trackings", lambda *_, **__: current)
    monkeypatch.setattr("mien.pipeline.track.show_tracking", lambda *_: None)
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


ACCEPTED = ("batch", "capture", "create", "drive", "export", "render", "view")
THINGS = {
    "a workspace": "W", "workspace": "W", "a video": "clip.mp4", "video": "clip.mp4", "a picture": "photo.jpg",
    "a folder of pictures": "pictures", "the folder of a video's pictures": "pictures",
    "a .csv of Live Link Face": "take.csv", "of ARKit's names": "time.csv", "a .json of blend shapes": "plain.json",
    "recording": "take.csv", "a sound file": "voice.wav", "sequence folder of the driver at rest": "W/sequences/clip",
    "first": "first", "calm": "calm", "model": "model",
}  # fmt: skip
"""Words of messages for what to give, and such a thing."""


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """Return a folder with a workspace W, one thing of each kind that can be given, and some that cannot."""
    shutil.copytree(toy_workspace(made_once), (things := tmp_path_factory.mktemp("place")) / "W")
    write_video(things / "clip.mp4", [np.zeros((16, 16, 3), np.uint8)] * 2, 25.0)
    write_tracks(things / "streams.mkv", [([flat(64)] * 2, False), ([flat(32)] * 2, False)])
    assert cv2.imwrite(str(things / "photo.jpg"), np.zeros((16, 16, 3), np.uint8))
    for folder, name in (("pictures", "photo.jpg"), ("one video", "clip.mp4")):
        (things / folder).mkdir()
        shutil.copy(things / name, things / folder)
    live_link_face(things, [{"jawOpen": 0.5}] * 3)
    table("time", 0.04)(things, [{"jawOpen": 0.5}] * 3)
    plain(things, [{"jawOpen": 0.5}] * 3)
    with wave.open(str(things / "voice.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(1600))
    for name, text in (("notes.txt", "Dear reader"), ("pose.bvh", "HIERARCHY\n")):
        (things / name).write_text(text)
    return things


def remedies(arguments: list[str], message: str) -> Iterator[list[str]]:
    """Yield the command as each remedy of a message changes it. The message begins with the wrong value."""
    for name in re.findall(r"leave (--[a-z.-]+) out", message):
        at = arguments.index(name)
        yield arguments[:at] + arguments[at + 2 :]
    option = re.match(r"(--[a-z.-]+)", message)
    if option and re.search(r"leave (it|one of them) out", message):
        at = arguments.index(option[1])
        yield arguments[:at] + arguments[at + 2 :]
    for index in re.findall(r"(\d+) \(\d+x\d+\)", message):
        at = arguments.index("--capture.stream") + 1
        yield [*arguments[:at], index, *arguments[at + 1 :]]
    for path in re.findall(r"give (.+?) itself", message):
        yield [path if word == str(Path(path).parent) else word for word in arguments]
    wrong = re.match(r"(?:--[a-z]+ )?([^:]+): ", message)
    told = re.split(r"; (?:give|what drives an avatar is) ", message)[-1]
    for words in re.split(r", or |, | or ", told):
        if words in THINGS and wrong is not None:
            yield [THINGS[words] if word == wrong[1] else word for word in arguments]


@pytest.mark.parametrize(("typed", "count"), [
    ("drive W --by missing --out a.mp4", 8),
    ("drive W --by missing", 8),
    ("drive W --by notes.txt --out a.mp4", 8),
    ("drive W --by pose.bvh --out a.mp4", 8),
    ("view W --play missing", 8),
    ("drive W --by take.csv --neutral missing --out a.mp4", 7),
    ("drive W --by take.csv --sequence a --out a.mp4", 1),
    ("drive W --by streams.mkv --out a.mp4 --capture.stream 7", 2),
    ("drive W --by take.csv --capture.stream 1 --out a.mp4", 1),
    ("create photo.jpg --out N", 2),
    ("capture photo.jpg --out N", 2),
])  # fmt: skip
def test_each_remedy_is_accepted(things: Path, monkeypatch: pytest.MonkeyPatch, capsys, typed: str, count: int) -> None:
    monkeypatch.chdir(things)
    for name in ACCEPTED:
        module = importlib.import_module(f"mien.commands.{name}")
        kinds = [module.Film, module.Show] if name == "drive" else [getattr(module, "TASKS", {}).get("")]
        for kind in kinds:
            monkeypatch.setattr(kind or module.Command, "run", lambda self: None)
    assert main(shlex.split(typed)) == 2
    (message,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mien: ")]
    assert len(found := list(remedies(shlex.split(typed), message.removeprefix("mien: ")))) == count, message
    for arguments in found:
        assert main(arguments) == 0, f"{message}\n{shlex.join(arguments)}\n{capsys.readouterr().err}"
