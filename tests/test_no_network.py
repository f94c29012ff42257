"""Every command works, and finds nobody to call, in a network namespace that has not even a loopback."""

import fcntl
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from batch_stub import PROGRAM
from mien.avatar import DEFAULT_METHOD
from mien.cli import COMMANDS
from needs import NO_NAMESPACE
from toy_workspace import write_toy_workspace
from viewer_alone import page_of

LINES = {
    "create": "{video} --out {out}/created --preset draft --steps 2 --alignment.when never",
    "capture": "{video} --out {out}/captured",
    "train": "{me} --run third --steps 2",
    "evaluate": "{me} --run {run}",
    "analyze": "gaussian-avatars {me} --run {run} --parts speed --seconds 0.01",
    "study": "make {me} --out {out}/study.html --seconds 0.2 --side 64",
    "render": "{mien} --out {out}/still.png",
    "drive": "{me} --run {run} --by {me} --out {out}/driven.mp4",
    "export": "{me} --run {run} --out {out}/me.html",
    "import": "{exported} --out {out}/imported",
    "batch": "{table} --out {out}/batch --program {stub}",
    "face-models": "--json",
    "bench": "render --seconds 0.01 --json",
    "licenses": "--json",
    "plugins": "--json",
    "track": "{me} --again",
    "align": "{me} --alignment.template-steps 2 --alignment.iterations 1",
}
"""A line of every command. `demo` makes the subject, and `view` has a test of its own. What changes the tracking comes
last, because runs of before cannot be scored then."""
DATASET = "gaussian-avatars"
_FLAGS, _SET_FLAGS, _UP = 0x8913, 0x8914, 1

DRAW = """
import sys
from dataclasses import replace
from pathlib import Path
from mien.lab.synthetic import RECIPES, write_synthetic_video
recipe = replace(RECIPES["demo"], seconds=0.6, width=192, height=192, supersample=1, texture_size=256)
write_synthetic_video(recipe, Path(sys.argv[1]), 0)
"""
ALL = """
import json, sys
from mien.cli import main
for line in json.loads(sys.argv[1]):
    print("CODE", line[0], main(line), flush=True)
"""


def offline(*arguments: str) -> str:
    """Run mien without any network and return what it says."""
    return python_offline("-m", "mien.cli", *arguments)


def python_offline(*arguments: str) -> str:
    done = subprocess.run(
        ["unshare", "-rn", sys.executable, *arguments], capture_output=True, text=True, timeout=400, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demo whose video, capture, tracking, training and report were made without a network; beside it, its files."""
    tried = subprocess.run(["unshare", "-rn", "true"], capture_output=True, check=False) if os.name == "posix" else None
    if tried is None or tried.returncode:
        pytest.skip(NO_NAMESPACE)
    folder = tmp_path_factory.mktemp("offline") / "me"
    folder.mkdir()
    # The demo takes a video that is there: this one has smaller pictures.
    python_offline("-c", DRAW, str(folder / "synthetic-0-0.6s.mp4"))
    offline("demo", "--out", str(folder), "--seconds", "0.6", "--steps", "2")
    offline("export", str(folder), "--out", str(folder.parent / "me.mien"))
    write_toy_workspace(folder.parent / "toy")
    offline("export", str(folder.parent / "toy"), "--out", str(folder.parent / "exported"), "--format", DATASET)
    return folder


def test_every_command_is_tried() -> None:
    assert {*LINES, "demo", "view"} == set(COMMANDS)


@pytest.mark.slow
def test_no_command_needs_a_network(subject: Path, tmp_path: Path) -> None:
    me, video = tmp_path / "me", next(subject.glob("synthetic*.mp4"))
    shutil.copytree(subject, me)
    shutil.copytree(me / "runs" / DEFAULT_METHOD, me / "runs" / "second")
    (tmp_path / "table.csv").write_text(f"video\n{video}\n")
    given = {
        "me": me, "run": DEFAULT_METHOD, "video": video, "out": tmp_path, "table": tmp_path / "table.csv",
        "mien": subject.parent / "me.mien", "exported": subject.parent / "exported", "stub": " ".join(PROGRAM),
    }  # fmt: skip
    lines = [[command, *(word.format(**given) for word in line.split())] for command, line in LINES.items()]
    told = python_offline("-c", ALL, json.dumps(lines))
    assert [line for line in told.splitlines() if line.startswith("CODE")] == [f"CODE {name} 0" for name in LINES], told


@pytest.mark.slow
def test_a_capture_by_litert_is_made_without_a_network(subject: Path) -> None:
    pytest.importorskip("ai_edge_litert", reason="could not import ai_edge_litert")
    video = next(subject.glob("synthetic*.mp4"))
    offline("capture", str(video), "--out", str(subject.parent / "other"), "--capture.detector", "litert")


@pytest.mark.slow
def test_the_viewer_needs_no_network_but_the_loopback(subject: Path) -> None:
    """It serves its page to this machine, where nothing else can be reached."""
    code = "import sys; from test_no_network import view_alone; view_alone(sys.argv[1])"
    avatar, here = str(subject.parent / "me.mien"), {"PYTHONPATH": str(Path(__file__).parent)}
    words = ["unshare", "-rn", sys.executable, "-c", code, avatar]
    done = subprocess.run(words, capture_output=True, text=True, timeout=400, check=False, env=os.environ | here)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "<html" in done.stdout


def view_alone(avatar: str) -> None:
    """Raise the loopback of this namespace, show an avatar, and print the viewer's page."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        asked = struct.pack("16sH14x", b"lo", 0)
        _, flags = struct.unpack("16sH14x", fcntl.ioctl(any_socket, _FLAGS, asked))
        fcntl.ioctl(any_socket, _SET_FLAGS, struct.pack("16sH14x", b"lo", flags | _UP))
    words = [sys.executable, "-m", "mien.cli", "view", avatar, "--port", "0"]
    print(page_of(words))
