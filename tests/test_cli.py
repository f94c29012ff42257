"""The command line has help, exit codes and one-line messages. A real run is in test_end_to_end.py."""

import importlib
import os
import re
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import cv2
import numpy as np
import pytest

from forked import ForkServer
from mien.cli import COMMANDS, main
from mien.commands.help_text import readable
from mien.files import write_atomically
from refusals import complaint

Told = pytest.CaptureFixture[str]


def help_of(capsys: Told, *arguments: str) -> str:
    """Ask for help, and return it."""
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_no_line_breaks_of_the_source_and_no_empty_defaults(name: str, capsys: Told) -> None:
    command = importlib.import_module(f"mien.commands.{name.replace('-', '_')}").Command
    hints = get_type_hints(readable(command), include_extras=True).values()
    texts = [mark.help for hint in hints for mark in get_args(hint)[1:] if getattr(mark, "help", None)]
    assert texts or name in ("bench", "study")  # which have sub-commands alone
    assert not [text for text in texts if "\n" in text]
    shown = help_of(capsys, name, "--help-all")
    assert f"usage: mien {name}" in shown
    assert "default: None)" not in shown
    assert "default: )" not in shown
    assert main(["--help"]) == 0
    assert f"  {name} " in capsys.readouterr().out


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


PROTOCOLS = "'insta', 'imavatar', 'nersemble', 'nersemble-benchmark', 'vhap', 'nerface', 'nerf-blendshape'"


@pytest.mark.parametrize(("arguments", "words"), [
    ("create a.mp4 --uot here", ("did you mean --out?",)),
    ("export --webcm here --out a.html", ("did you mean --webcam?",)),  # tyro takes the folder for its value
    ("train here --training.step 3", ("did you mean --steps?",)),
    ("create --method headgas --step 3 --out here a.mp4", ("did you mean --steps?",)),
    ("render here --out a.mp4 --siez 3", ("--siez", "did you mean --size?", "see mien render --help")),
    ("create", ("--out DIR", "see mien create --help")),
    ("render DIR --out a.png --set jawOpen=1 --set=eyeBlinkLeft=1", ("--set is given twice",)),
    ("demo --out demo --out=", ("--out= is empty",)),  # as a path, the current folder (found by the fuzzer, seed 5)
    ("train here --method.appearance nonsense", ("nonsense", "features", "see mien train --help-all")),
    ("create a.mp4 --out here --steps many", ("--steps", "'many'")),
    ("create none.mp4 --out here --method nerf", ("instead of 'nerf'",)),
    ("track here --tracking.keyframes -1", ("--tracking.keyframes -1",)),
    ("bench nothing", ("nothing", "render, train-step, scaling, quality, compare")),
    # Choices in the order of their declaration, without None, which cannot be typed.
    ("evaluate x --protocol None", (f"mien: --protocol: give one of {PROTOCOLS} instead of 'None'; see mien",)),
    ("capture x --out y --capture.turn 45", ("--capture.turn: give one of '0', '90', '180', '270' instead of",)),
])  # fmt: skip
def test_wrong_arguments_are_told_in_one_line(arguments: str, words: tuple[str, ...], tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    message = complaint(capsys, *arguments.split())
    assert all(word in message for word in words), message
    if words[0].startswith("did you mean"):
        assert "a.mp4" not in message
        assert "missing" not in message
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
    monkeypatch.setattr("mien.workspace.Workspace.sequence_names", lambda self: 1 / 0)
    assert main(["track", str(tmp_path)]) == 1
    shown = capsys.readouterr().err
    assert "bug in mien" in shown
    assert not [word for word in ("Traceback", "\x1b") if word in shown]
    (log,) = tmp_path.glob("mien-crash-*.log")
    assert "ZeroDivisionError" in log.read_text()


STOPPED = "mien: stopped; the same command continues where it stopped, or starts again\n"


@dataclass(frozen=True)
class Terminated:
    """A command that is terminated while it writes, twice."""

    out: Path

    def check(self) -> None:
        """Accept everything."""

    def run(self) -> None:
        """Write half a film."""
        write_atomically(self.out, self._write)

    def _write(self, path: Path) -> None:
        path.write_text("half")
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            print("cleaned up")


def end_terminated(words: list[str]) -> int:
    """Run that command in this process, which must be a fork."""
    sys.modules["mien.commands.demo"] = SimpleNamespace(Command=Terminated)  # type: ignore[assignment]
    return main(words)


def test_a_terminated_command_removes_what_is_unfinished(fork_server: ForkServer, tmp_path: Path) -> None:
    """A terminated command removes unfinished files, as after Ctrl-C, even if a second signal comes meanwhile."""
    words = ["demo", "--out", str(tmp_path / "film.mp4")]
    ended = fork_server.call("test_cli:end_terminated", words, exits=True)
    assert (ended.wait(), ended.stdout, ended.stderr) == (143, "cleaned up\n", STOPPED)
    assert list(tmp_path.iterdir()) == []
