"""A viewer shows an avatar while it trains: training stays the same, and nothing is left behind."""

import os
import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import train_toy
from capture_helpers import tree_bytes
from forked import ForkServer
from mien import runtime
from mien.avatar import Avatar, make_portable
from mien.cli import main
from mien.commands import options
from mien.commands.stages import live_view, viewing
from mien.commands.stages.live_view import LiveView
from mien.training import train
from mien.viewer import Session
from shared_things import MadeOnce, toy_workspace
from test_runtime import new_avatar
from toy_scene import toy_camera, toy_sequence
from web_case import until


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Files of the viewers that were started. They are programs that do nothing."""
    files: list[Path] = []

    def start(file: Path) -> "subprocess.Popen[bytes]":
        files.append(file)
        return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])

    monkeypatch.setattr(live_view, "start_viewer", start)
    return files


def test_states_are_written_from_time_to_time(started: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(live_view.time, "monotonic", lambda: now[0])
    avatar, live = new_avatar("gaussian_avatars"), LiveView("toy", toy_camera(32))
    live(avatar)
    (file,) = started
    first = runtime.read_portable(file)
    with torch.no_grad():
        avatar.store["means"].add_(0.01)  # type: ignore[attr-defined]
    now[0] += 1.9
    live(avatar)
    assert runtime.read_portable(file).baked.means.tolist() == first.baked.means.tolist()  # type: ignore[union-attr]
    now[0] += 0.2
    live(avatar)
    assert runtime.read_portable(file).baked.means.tolist() != first.baked.means.tolist()  # type: ignore[union-attr]
    assert len(started) == 1
    live.close()
    assert not file.parent.exists()


def test_what_cannot_be_shown_is_said_once(started: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    live = LiveView("toy", toy_camera(32))
    for _ in range(3):
        live(new_avatar("headgas", variant="delta"))
    live.close()
    told = capsys.readouterr().err
    assert told.count("--view: the avatar cannot be shown") == 1
    assert "training goes on without a viewer" in told
    assert started == []


def test_a_watched_training_has_the_same_bytes(
    started: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_view, "LEAST_SECONDS", 0.0)
    face_model, sequence = toy_sequence(5, 32)
    live = LiveView("toy", toy_camera(32))
    seen = []

    def watch(avatar: Avatar) -> None:
        seen.append(avatar)
        live(avatar)

    settings = replace(train_toy.SETTINGS, steps=12)
    for name, watching in (("plain", None), ("watched", watch)):
        train([sequence], face_model, train_toy.CONFIG, settings, tmp_path / name, watch=watching)
    live.close()
    assert len(seen) == 12
    assert len(started) == 1
    plain, watched = (tree_bytes(tmp_path / name / "avatar") for name in ("plain", "watched"))
    assert plain == watched


def test_a_viewer_follows_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A damaged state is left out. If the training is gone, the viewer ends itself."""
    file, avatar = tmp_path / "a.mien", new_avatar("gaussian_avatars")
    runtime.write_portable(file, make_portable(avatar, toy_camera(32), "toy"))
    session, signals, turns = Session(runtime.load(file)), [], iter(range(5))
    before = session.avatar

    def sleep(_: float) -> None:
        turn = next(turns)
        if turn == 1:
            file.write_bytes(b"damaged")
        if turn == 2:
            assert session.avatar is before
            runtime.write_portable(file, make_portable(avatar, toy_camera(32), "toy"))
        if turn == 4:
            assert session.avatar is not before
            monkeypatch.setenv(live_view.PARENT_VARIABLE, "1")

    monkeypatch.setattr(viewing.time, "sleep", sleep)
    monkeypatch.setattr(viewing.os, "kill", lambda process, number: signals.append((process, number)))
    monkeypatch.setenv(live_view.PARENT_VARIABLE, str(os.getppid()))
    with pytest.raises(StopIteration):
        viewing.follow_file(session, file)
    monkeypatch.setenv(live_view.PARENT_VARIABLE, "1")
    monkeypatch.setattr(viewing.time, "sleep", lambda _: None)
    viewing.follow_file(session, file)
    assert signals == [(os.getpid(), signal.SIGTERM)]
    assert session.version > 0


def test_options_are_checked(
    made_once: MadeOnce, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = str(toy_workspace(made_once))
    assert main(["view", workspace, "--follow"]) == 2
    assert "--follow: needs a .mien file" in capsys.readouterr().err
    monkeypatch.setattr(options.importlib.util, "find_spec", lambda name: None)
    assert main(["train", workspace, "--view"]) == 2
    assert "pip install 'mien[viewer]'" in capsys.readouterr().err


def watched_training(folder: str) -> None:
    """Train with a viewer until Ctrl-C."""
    face_model, sequence = toy_sequence(5, 32)
    live, settings = LiveView("toy", toy_camera(32)), replace(train_toy.SETTINGS, steps=1_000_000)
    try:
        train([sequence], face_model, train_toy.CONFIG, settings, Path(folder), watch=live)
    finally:
        live.close()


def test_a_browser_can_watch_a_training(tmp_path: Path, fork_server: ForkServer) -> None:
    """The address is printed early, and answers; Ctrl-C ends training and viewer, and leaves no file."""
    environment = {"TMPDIR": str(tmp_path)}
    process = fork_server.call("test_live_view:watched_training", str(tmp_path / "run"), env=environment)
    try:
        until(lambda: "Open http" in process.stderr or process.poll() is not None)
        address = next(word for word in process.stderr.split() if word.startswith("http"))
        browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        assert browser.open(address, timeout=60).status == 200
        assert list(tmp_path.glob("mien-view-*/training.mien"))
        process.send_signal(signal.SIGINT)
        assert process.wait() != 0
    finally:
        process.kill()
    assert "The viewer is closed; `mien view` shows the finished avatar" in process.stderr
    assert not list(tmp_path.glob("mien-view-*"))
    with pytest.raises(OSError):  # noqa: PT011
        urllib.request.urlopen(address, timeout=5)
