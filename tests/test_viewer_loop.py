"""The viewer's loop, which draws for its clients in turn, and its worker for what takes long."""

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from mien.viewer.drawing import View
from mien.viewer.loop import STILL_SECONDS, DrawingLoop
from mien.viewer.work import Worker


class Stage:
    """A loop with a clock that stands still, and drawings that take as long as one wants."""

    def __init__(
        self, *clients: int, seconds: float = 0.1, advance: Callable[[float], float | None] | None = None
    ) -> None:
        self.now, self.seconds = 100.0, seconds
        self.drawn: list[tuple[int, bool]] = []
        self.shown: list[tuple[int, int, bool]] = []
        self.take(DrawingLoop(self.draw, advance, lambda: self.now), *clients)

    def take(self, loop: DrawingLoop, *clients: int) -> None:
        self.loop = loop
        for client in clients:
            self.add(client)

    def draw(self, view: View, full: bool) -> int:
        self.now += self.seconds
        self.drawn.append((view.width, full))
        return view.width

    def add(self, client: int) -> None:
        self.loop.add(client, lambda picture, full: self.shown.append((client, picture, full)))

    def look(self, client: int, width: int) -> None:
        self.loop.look(client, View(np.eye(4), 0.5, width, 10))


def test_the_newest_request_wins() -> None:
    stage = Stage(1)
    assert stage.loop.step() is None
    for width in (11, 12, 13):
        stage.look(1, width)
    assert stage.loop.step() == 0
    assert stage.shown == [(1, 13, False)]


def test_pictures_are_full_when_nothing_moves() -> None:
    stage = Stage(1)
    stage.look(1, 11)
    stage.loop.step()
    rest = stage.loop.step()
    assert rest == pytest.approx(STILL_SECONDS - stage.seconds)
    assert rest is not None
    stage.now += rest
    stage.loop.step()
    assert stage.shown == [(1, 11, False), (1, 11, True)]
    assert stage.loop.step() is None
    stage.loop.change()
    stage.loop.step()
    assert stage.shown[2:] == [(1, 11, False)]


def test_quick_pictures_are_always_full() -> None:
    stage = Stage(1, seconds=0.004)
    sizes = []
    for seconds in (0.004, 0.016, 0.016, 0.03, 0.03, 0.03, 0.09, 0.0225, 0.0075, *[0.0035] * 6):
        stage.seconds = seconds
        stage.look(1, 11)
        stage.loop.step()
        sizes.append(stage.drawn[-1][1])
    # It starts with half size; 30 ms do not change it, 90 ms do, and back only far below.
    assert sizes[:9] == [False, *[True] * 6, False, False]
    assert sizes[-1]


def test_two_clients_take_turns() -> None:
    stage = Stage(1, 2)
    for width in range(11, 17):
        stage.look(1, width)
        stage.look(2, width)
        stage.loop.step()
    counts = [sum(client == shown for shown, _, _ in stage.shown) for client in (1, 2)]
    assert counts == [3, 3]


def test_a_client_that_vanished_is_not_shown() -> None:
    stage = Stage(1, 2)
    stage.look(1, 11)
    stage.look(2, 12)
    stage.loop.remove(1)
    stage.loop.remove(7)
    stage.look(1, 13)
    while stage.loop.step() == 0:
        pass
    assert {client for client, _, _ in stage.shown} == {2}

    def vanish(view: View, full: bool) -> int:
        stage.loop.remove(2)
        return view.width

    stage.take(DrawingLoop(vanish, clock=lambda: stage.now), 2)
    stage.look(2, 14)
    stage.loop.step()
    assert all(picture != 14 for _, picture, _ in stage.shown)


def test_the_loop_wakes_for_what_plays() -> None:
    times = iter((None, 100.7))
    stage = Stage(advance=lambda now: next(times))
    assert stage.loop.step() is None
    assert stage.loop.step() == pytest.approx(0.7)


def test_a_picture_that_fails_concerns_its_client_alone() -> None:
    failures: list[Exception] = []

    def draw(view: View, full: bool) -> int:
        if view.width == 13:
            raise ArithmeticError("a bug")
        return view.width

    def show(picture: int, full: bool) -> None:
        raise ConnectionError("the browser is gone")

    stage = Stage()
    stage.take(DrawingLoop(draw, clock=lambda: stage.now, failed=failures.append), 1, 2)
    stage.look(1, 13)
    stage.look(2, 14)
    assert [stage.loop.step() for _ in range(2)] == [0, 0]
    assert stage.shown == [(2, 14, False)]
    assert [str(failure) for failure in failures] == ["a bug"]
    stage.loop.add(3, show)
    stage.look(3, 12)
    assert stage.loop.step() == 0
    assert [str(failure) for failure in failures] == ["a bug", "the browser is gone"]
    stage.loop.remove(3)
    stage.now += STILL_SECONDS
    assert [stage.loop.step() for _ in range(2)] == [0, None], "what failed is not tried again"
    stage.look(1, 15)
    assert stage.loop.step() == 0
    assert stage.shown[-1][:2] == (1, 15)


def test_a_failure_that_concerns_all_ends_the_loop_and_is_kept() -> None:
    def fail(now: float) -> float:
        raise ArithmeticError("a bug")

    loop = DrawingLoop(lambda view, full: 0, fail)
    loop.start()
    loop.wait(60.0)
    assert not loop.running
    assert isinstance(loop.error, ArithmeticError)
    loop.stop()


def test_the_loop_stops() -> None:
    loop = DrawingLoop(lambda view, full: 0, lambda now: now + 1000)
    loop.start()
    loop.stop()
    assert not loop.running
    assert loop.error is None


def test_a_worker_bounds_what_waits() -> None:
    begun, go_on, done, failures = threading.Event(), threading.Event(), [], []

    def slow() -> None:
        begun.set()
        go_on.wait()
        done.append("slow")

    worker = Worker("test", failures.append, most=2)
    assert worker.ask("a", slow)
    assert begun.wait(60)
    assert worker.ask("b", lambda: done.append("old"))
    assert worker.ask("b", lambda: done.append("new")), "the newest of a kind wins"
    assert worker.ask("c", lambda: done.append(1 // 0))
    assert not worker.ask("d", lambda: done.append("too much"))
    go_on.set()
    while len(failures) < 1:
        time.sleep(0.001)
    assert done == ["slow", "new"]
    assert isinstance(failures[0], ZeroDivisionError)
    worker.stop()
    assert not worker.ask("e", lambda: done.append("stopped"))


def test_a_worker_without_a_queue_takes_nothing_while_it_works() -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow() -> None:
        begun.set()
        go_on.wait()

    worker = Worker("test", print, most=0)
    assert worker.ask(1, slow)
    assert begun.wait(60)
    assert not worker.ask(2, slow)
    go_on.set()
    worker.stop()
