"""The viewer's door, loop and worker, and a viewer that shows an avatar while it trains."""

import os
import signal
import subprocess
import sys
import threading
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import numpy as np
import pytest
import torch

import train_toy
from capture_helpers import tree_bytes
from forked import ForkServer
from known import known
from mien import runtime
from mien.avatar.baking import make_portable
from mien.pipeline import view as viewing
from mien.pipeline import view_training
from mien.pipeline.view_training import TrainingView
from mien.training import train
from mien.viewer.access import Door, is_loopback
from mien.viewer.drawing import View
from mien.viewer.loop import STILL_SECONDS, DrawingLoop, Worker
from mien.viewer.session import Session
from refusals import refuses
from test_runtime import new_avatar
from toy_scene import toy_camera, toy_sequence
from web_case import until


def test_only_loopback_goes_without_a_token_and_strange_hosts_and_origins_are_refused() -> None:
    for host in ("127.0.0.1", "::1", "localhost"):
        assert is_loopback(host), host
        assert Door.of(host, with_token=False).token is None
    for host in ("0.0.0.0", "example.org", "192.168.1.2", "localhost.evil.example", "127.0.0.1.evil.example"):
        assert not is_loopback(host), host
        assert Door.of(host).token is not None
        refuses(f"--no-token: other machines can reach --host {host}", Door.of, host, with_token=False)
    door = Door.of("127.0.0.1", with_token=False)
    assert door.answer("/", {"Host": "127.0.0.1:80"}) is None
    assert door.answer("/", {"Host": "localhost:80", "Origin": "http://localhost:80"}) is None
    ports = ("81", "8", "80.evil.example")
    origins = ("http://evil.example", *(f"http://127.0.0.1:{port}" for port in ports), "null", "http://[v1.\udc80]")
    from_elsewhere = ({"Host": "127.0.0.1:80", "Origin": origin} for origin in origins)
    strange = ("rebound.example:80", "[::1", "localhost.evil.example", "127.0.0.1.evil.example:80", "evil-localhost:80")
    for headers in ({}, *({"Host": host} for host in strange), {"Origin": "http://["}, *from_elsewhere):
        answer = door.answer("/", headers)
        assert answer is not None, headers
        assert answer.status == 403


def test_a_token_becomes_a_cookie_also_behind_a_proxy_with_a_path_of_its_own() -> None:
    """The redirect and the cookie stay below that path, and other hosts are fine with the token."""
    door = Door.of("127.0.0.1")
    there = {"Host": "me.example", "Origin": "https://me.example"}
    first = known(door.answer(f"/?token={door.token}", there))
    onward = urljoin("https://me.example/mien/?token=x", first.headers["Location"])
    assert onward == "https://me.example/mien/index.html"
    assert "Path" not in first.headers["Set-Cookie"]
    assert door.answer("/index.html", {**there, "Cookie": door.cookie}) is None
    lost = known(door.answer("/", {"Host": "127.0.0.1:80", "Origin": "https://me.example", "Cookie": door.cookie}))
    assert "page of https://me.example, and its Host is 127.0.0.1:80" in lost.body.decode()
    assert "let the proxy pass on the browser's Host header" in lost.body.decode()
    door = Door.of("0.0.0.0")
    assert door.token is not None
    assert len(door.token) >= 20
    assert door.token != Door.of("0.0.0.0").token
    here = {"Host": "me.example:80"}
    first = known(door.answer(f"/?token={door.token}", here))
    assert (first.status, first.headers["Location"]) == (303, "index.html")
    given, *attributes = first.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(attributes)
    assert door.answer("/", {**here, "Cookie": f"a=b; {given}"}) is None
    assert door.answer("/", {**here, "cookie": given, "origin": "http://me.example:80"}) is None
    evil = {"Cookie": given, "Origin": "http://evil.example"}
    for path, headers in (("/?token=", {}), ("/", {"Cookie": given[:-1]}), ("/", evil), ("/", {"Cookie": "é=[,"})):
        answer = door.answer(path, {**here, **headers})
        assert answer is not None, (path, headers)
        assert answer.status == 403
    assert door.address("::1", 7).startswith("http://[::1]:7/?token=")


class Stage:
    """A loop with a clock that stands still, and drawings that take as long as one wants."""

    def __init__(self, *clients: int, seconds: float = 0.1, **given: Any) -> None:
        self.now, self.seconds = 100.0, seconds
        self.drawn: list[tuple[int, bool]] = []
        self.shown: list[tuple[int, int, bool]] = []
        self.loop = DrawingLoop(given.pop("draw", self.draw), clock=lambda: self.now, **given)
        for client in clients:
            self.loop.add(client, lambda picture, full, client=client: self.shown.append((client, picture, full)))

    def draw(self, view: View, full: bool) -> int:
        self.now += self.seconds
        self.drawn.append((view.width, full))
        return view.width

    def look(self, client: int, width: int) -> None:
        self.loop.look(client, View(np.eye(4), 0.5, width, 10))


def test_the_newest_request_wins_and_pictures_are_full_when_nothing_moves() -> None:
    stage = Stage(1)
    assert stage.loop.step() is None
    for width in (13, 12, 11):
        stage.look(1, width)
    assert stage.loop.step() == 0
    assert stage.loop.step() == pytest.approx(STILL_SECONDS - stage.seconds)
    stage.now += STILL_SECONDS - stage.seconds
    stage.loop.step()
    assert stage.shown == [(1, 11, False), (1, 11, True)]
    assert stage.loop.step() is None
    stage.loop.change()
    stage.loop.step()
    assert stage.shown[2:] == [(1, 11, False)]


def test_two_clients_take_turns_until_one_vanishes() -> None:
    stage = Stage(1, 2)
    for width in range(11, 17):
        stage.look(1, width)
        stage.look(2, width)
        stage.loop.step()
    assert sorted(client for client, _, _ in stage.shown) == [1, 1, 1, 2, 2, 2]
    stage.loop.remove(1)
    stage.loop.remove(7)
    stage.shown.clear()
    for client in (1, 2):
        stage.look(client, 17)
    while stage.loop.step() == 0:
        pass
    assert {client for client, _, _ in stage.shown} == {2}

    def vanish(view: View, full: bool) -> int:
        stage.loop.remove(2)
        return view.width

    stage = Stage(2, draw=vanish)
    stage.look(2, 14)
    stage.loop.step()
    assert stage.shown == []


def test_a_picture_that_fails_concerns_its_client_alone() -> None:
    failures: list[Exception] = []

    def draw(view: View, full: bool) -> int:
        if view.width == 13:
            raise ArithmeticError("a bug")
        return view.width

    def show(picture: int, full: bool) -> None:
        raise ConnectionError("the browser is gone")

    stage = Stage(1, 2, draw=draw, failed=failures.append)
    stage.look(1, 13)
    stage.look(2, 14)
    assert ([stage.loop.step() for _ in range(2)], stage.shown) == ([0, 0], [(2, 14, False)])
    stage.loop.add(3, show)
    stage.look(3, 12)
    assert stage.loop.step() == 0
    assert [str(failure) for failure in failures] == ["a bug", "the browser is gone"]
    stage.loop.remove(3)
    stage.now += STILL_SECONDS
    assert [stage.loop.step() for _ in range(2)] == [0, None], "what failed is not tried again"
    stage.look(1, 15)
    assert (stage.loop.step(), stage.shown[-1][:2]) == (0, (1, 15))


def test_the_loop_stops_and_a_failure_that_concerns_all_ends_it_and_is_kept() -> None:
    for advance, failure in ((lambda now: 1 / 0, ZeroDivisionError), (lambda now: now + 1000, type(None))):
        loop = DrawingLoop(lambda view, full: 0, advance)
        loop.start()
        if failure is ZeroDivisionError:
            loop.wait(60.0)
            assert not loop.running
        loop.stop()
        assert not loop.running
        assert isinstance(loop.error, failure)


@pytest.mark.parametrize("most", [0, 2])
def test_a_worker_bounds_what_waits(most: int) -> None:
    begun, go_on, done, failures = threading.Event(), threading.Event(), [], []

    def slow() -> None:
        begun.set()
        go_on.wait()
        done.append("slow")

    worker = Worker("test", failures.append, most=most)
    assert worker.ask("a", slow)
    assert begun.wait(60)
    if most:
        assert worker.ask("b", lambda: done.append("old"))
        assert worker.ask("b", lambda: done.append("new")), "the newest of a kind wins"
        assert worker.ask("c", lambda: done.append(1 // 0))
    assert not worker.ask("d", lambda: done.append("too much"))
    go_on.set()
    until(lambda: len(done) + len(failures) == (3 if most else 1))
    worker.stop()
    assert done == ["slow", "new"][: 1 + most]
    assert [type(failure) for failure in failures] == [ZeroDivisionError] * (most // 2)
    assert not worker.ask("e", lambda: done.append("stopped"))


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    files: list[Path] = []

    def start(file: Path) -> "subprocess.Popen[bytes]":
        files.append(file)
        return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])

    monkeypatch.setattr(view_training, "start_viewer", start)
    return files


def test_states_are_written_from_time_to_time(
    started: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """What cannot be shown is said once."""
    now = [100.0]
    monkeypatch.setattr(view_training.time, "monotonic", lambda: now[0])
    avatar, live = new_avatar("gaussian_avatars"), TrainingView("toy", toy_camera(32))
    live(avatar)
    (file,) = started
    first = file.read_bytes()
    with torch.no_grad():
        avatar.store["means"].add_(0.01)  # type: ignore[attr-defined]
    for seconds, same in ((1.9, True), (0.2, False)):
        now[0] += seconds
        live(avatar)
        assert (file.read_bytes() == first) is same
    live.close()
    assert not file.parent.exists()
    other = TrainingView("toy", toy_camera(32))
    for _ in range(3):
        other(new_avatar("headgas", variant="delta"))
    other.close()
    told = capsys.readouterr().err
    assert told.count("the growing avatar cannot be shown") == 1
    assert "training goes on without that" in told
    assert len(started) == 1
    growing = TrainingView("toy", toy_camera(32), tmp_path / "growing.mien", viewer=False)
    growing(avatar)
    growing.close()
    assert (tmp_path / "growing.mien").is_file(), "it stays"
    assert len(started) == 1, "nobody asked for a viewer"


def test_a_watched_training_has_the_same_bytes(started: list[Path], tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(view_training, "LEAST_SECONDS", 0.0)
    face_model, sequence = toy_sequence(5, 32)
    live, seen, settings = TrainingView("toy", toy_camera(32)), [], replace(train_toy.SETTINGS, steps=12)
    for name, watch in (("plain", None), ("watched", lambda avatar: seen.append(live(avatar)))):
        train([sequence], face_model, train_toy.CONFIG, settings, tmp_path / name, watch=watch)
    live.close()
    assert (len(seen), len(started)) == (12, 1)
    assert tree_bytes(tmp_path / "plain" / "avatar") == tree_bytes(tmp_path / "watched" / "avatar")


def test_a_viewer_follows_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
            monkeypatch.setenv(view_training.PARENT_VARIABLE, "1")

    monkeypatch.setattr(viewing.time, "sleep", sleep)
    monkeypatch.setattr(viewing.os, "kill", lambda process, number: signals.append((process, number)))
    monkeypatch.setenv(view_training.PARENT_VARIABLE, str(os.getppid()))
    pytest.raises(StopIteration, viewing.follow_file, session, file)
    monkeypatch.setenv(view_training.PARENT_VARIABLE, "1")
    monkeypatch.setattr(viewing.time, "sleep", lambda _: None)
    viewing.follow_file(session, file)
    assert signals == [(os.getpid(), signal.SIGTERM)]


def watched_training(folder: str) -> None:
    face_model, sequence = toy_sequence(5, 32)
    live, settings = TrainingView("toy", toy_camera(32)), replace(train_toy.SETTINGS, steps=1_000_000)
    try:
        train([sequence], face_model, train_toy.CONFIG, settings, Path(folder), watch=live)
    finally:
        live.close()


def test_a_browser_can_watch_a_training(tmp_path: Path, fork_server: ForkServer) -> None:
    environment = {"TMPDIR": str(tmp_path)}
    process = fork_server.call("test_viewer_parts:watched_training", str(tmp_path / "run"), env=environment)
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
