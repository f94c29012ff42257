"""What a message advises works: each remedy of a message is fed back to the same command, which then accepts it."""

import importlib
import re
import shlex
import shutil
import wave
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien.capture.video import write_video
from mien.cli import main
from recordings import live_link_face, plain, table
from shared_things import MadeOnce, toy_workspace

COMMANDS = ("batch", "capture", "create", "drive", "export", "render", "view")
THINGS = {
    "a workspace": "W", "workspace": "W", "a video": "clip.mp4", "video": "clip.mp4", "a picture": "photo.jpg",
    "a folder of pictures": "pictures", "the folder of a video's pictures": "pictures",
    "a .csv of Live Link Face": "take.csv", "of ARKit's names": "time.csv", "a .json of blend shapes": "plain.json",
    "recording": "take.csv", "a sound file": "voice.wav", "sequence folder of the driver at rest": "W/sequences/clip",
    "first": "first", "calm": "calm", "model": "model",
}  # fmt: skip
"""Words of messages for what to give, and such a thing."""
NOT_GIVEN = "missing"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """Return a folder with a workspace W, one thing of each kind that can be given, and some that cannot."""
    place = tmp_path_factory.mktemp("place")
    shutil.copytree(toy_workspace(made_once), place / "W")
    write_video(place / "clip.mp4", [np.zeros((16, 16, 3), np.uint8)] * 2, 25.0)
    assert cv2.imwrite(str(place / "photo.jpg"), np.zeros((16, 16, 3), np.uint8))
    for folder, name in (("pictures", "photo.jpg"), ("one video", "clip.mp4")):
        (place / folder).mkdir()
        shutil.copy(place / name, place / folder)
    live_link_face(place, [{"jawOpen": 0.5}] * 3)
    table("time", 0.04)(place, [{"jawOpen": 0.5}] * 3)
    plain(place, [{"jawOpen": 0.5}] * 3)
    with wave.open(str(place / "voice.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(1600))
    (place / "notes.txt").write_text("Dear reader")
    (place / "pose.bvh").write_text("HIERARCHY\n")
    return place


def remedies(arguments: list[str], message: str) -> Iterator[list[str]]:
    """Yield the command as each remedy of a message changes it. The message begins with the wrong value."""
    for name in re.findall(r"leave (--[a-z.-]+) out", message):
        at = arguments.index(name)
        yield arguments[:at] + arguments[at + 2 :]
    option = re.match(r"(--[a-z.-]+)", message)
    if option and re.search(r"leave (it|one of them) out", message):
        at = arguments.index(option[1])
        yield arguments[:at] + arguments[at + 2 :]
    for words in re.findall(r"needs (--[a-z]+ [A-Za-z.0-9]+),? .*add it", message):
        yield [*arguments, *shlex.split(words)]
    for path in re.findall(r"give (.+?) itself", message):
        yield [path if word == str(Path(path).parent) else word for word in arguments]
    wrong = re.match(r"(?:--[a-z]+ )?([^:]+): ", message)
    told = re.split(r"; (?:give|what drives an avatar is) ", message)[-1]
    for words in re.split(r", or |, | or ", told):
        if words in THINGS and wrong is not None:
            yield [THINGS[words] if word == wrong[1] else word for word in arguments]


@pytest.mark.parametrize(("typed", "count"), [
    (f"drive W --by {NOT_GIVEN} --out a.mp4", 8),
    (f"drive W --by {NOT_GIVEN}", 8),
    ("drive W --by notes.txt --out a.mp4", 8),
    ("drive W --by pose.bvh --out a.mp4", 8),
    (f"view W --play {NOT_GIVEN}", 8),
    (f"drive W --by take.csv --neutral {NOT_GIVEN} --out a.mp4", 7),
    ("drive W --by take.csv --sequence a --out a.mp4", 1),
    ("drive W --by take.csv --fps 70", 1),
    ("drive W --by clip.mp4 --camera-format v4l2 --out a.mp4", 1),
    ("create photo.jpg --out N", 2),
    ("capture photo.jpg --out N", 2),
])  # fmt: skip
def test_each_remedy_is_accepted(place: Path, monkeypatch: pytest.MonkeyPatch, capsys, typed: str, count: int) -> None:
    monkeypatch.chdir(place)
    for name in COMMANDS:
        monkeypatch.setattr(importlib.import_module(f"mien.commands.{name}").Command, "run", lambda self: None)
    assert main(shlex.split(typed)) == 2
    (message,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mien: ")]
    found = list(remedies(shlex.split(typed), message.removeprefix("mien: ")))
    assert len(found) == count, message
    for arguments in found:
        assert main(arguments) == 0, f"{message}\n{shlex.join(arguments)}\n{capsys.readouterr().err}"
