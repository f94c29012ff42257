"""Every command works, and finds nobody to call, in a network namespace that has not even a loopback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mien.avatar import DEFAULT_METHOD
from needs import NO_NAMESPACE

DRAW = """
import sys
from dataclasses import replace
from pathlib import Path
from mien.lab.synthetic import RECIPES, write_synthetic_video
recipe = replace(RECIPES["demo"], seconds=0.6, width=192, height=192, supersample=1, texture_size=256)
write_synthetic_video(recipe, Path(sys.argv[1]), 0)
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
    """A demo whose video, capture, tracking, training and report were made without a network."""
    tried = subprocess.run(["unshare", "-rn", "true"], capture_output=True, check=False) if os.name == "posix" else None
    if tried is None or tried.returncode:
        pytest.skip(NO_NAMESPACE)
    folder = tmp_path_factory.mktemp("offline") / "me"
    folder.mkdir()
    # The demo takes a video that is there: this one has smaller pictures.
    python_offline("-c", DRAW, str(folder / "synthetic-0-0.6s.mp4"))
    offline("demo", "--out", str(folder), "--seconds", "0.6", "--steps", "2")
    return folder


@pytest.mark.slow
def test_an_avatar_is_made_and_used_without_a_network(subject: Path) -> None:
    run = subject / "runs" / DEFAULT_METHOD
    assert (run / "report.html").is_file()
    avatar, out = str(subject), subject.parent
    for ending in ("html", "mien"):
        offline("export", avatar, "--out", str(out / f"me.{ending}"))
    offline("render", str(out / "me.mien"), "--out", str(out / "still.png"), "--size", "64")
    offline("drive", avatar, "--by", avatar, "--out", str(out / "driven.mp4"), "--size", "64")
    assert (out / "still.png").is_file()
    assert (out / "driven.mp4").is_file()


@pytest.mark.slow
def test_a_capture_by_litert_is_made_without_a_network(subject: Path) -> None:
    pytest.importorskip("ai_edge_litert", reason="could not import ai_edge_litert")
    video = next(subject.glob("synthetic*.mp4"))
    offline("capture", str(video), "--out", str(subject.parent / "other"), "--capture.detector", "litert")


@pytest.mark.parametrize("command", ["view", "create", "study", "bench"])
def test_help_needs_no_network(subject: Path, command: str) -> None:
    assert f"mien {command}" in offline(command, "--help")


def test_licences_and_plugins_need_no_network(subject: Path) -> None:
    assert "mien" in offline("licenses", "--json")
    offline("plugins")
