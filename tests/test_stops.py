"""Signals stop work in an orderly way: once, at a moment that suits, and even if a library drops them."""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable

import pytest

from forked import ForkServer
from mien import stops
from mien.stops import EXIT_HUNG_UP, EXIT_TERMINATED, HungUp, Put, Terminated, orderly_stops, stops_put_off

KINDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated, signal.SIGHUP: HungUp}
of_every_kind = pytest.mark.parametrize("number", KINDS)


def orderly(number: signal.Signals, work: Callable[[], object]) -> None:
    """Do work that a signal stops."""
    with pytest.raises(KINDS[number]), orderly_stops():
        work()


@of_every_kind
def test_a_second_signal_does_not_interrupt_the_removal(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in KINDS]
    removed = []

    def work() -> None:
        try:
            signal.raise_signal(number)
        finally:
            for each in KINDS:
                signal.raise_signal(each)
            removed.append("half a file")

    orderly(number, work)
    assert removed == ["half a file"]
    assert [signal.getsignal(each) for each in KINDS] == before


@of_every_kind
def test_a_stop_that_is_dropped_comes_again(number: signal.Signals) -> None:
    """Python can only report an exception in a callback of a library, or in a finaliser. The stop is not lost."""

    class Finalised:
        def __del__(self) -> None:
            signal.raise_signal(number)

    def work() -> None:
        Finalised()
        for _ in range(2000):
            time.sleep(0.05)

    hook = sys.unraisablehook
    orderly(number, work)
    assert sys.unraisablehook is hook


@of_every_kind
def test_an_error_that_a_library_makes_of_a_stop_is_the_stop(number: signal.Signals) -> None:
    """Found by killing `mien capture` while it imported: ImportError: initialization failed."""

    def work() -> None:
        try:
            signal.raise_signal(number)
        except BaseException:  # noqa: BLE001
            raise ImportError("initialization failed") from None

    orderly(number, work)


def test_a_later_signal_counts_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A library may swallow a stop. A user who stops once more is heard."""
    monkeypatch.setattr(stops, "DEAF_SECONDS", -1.0)

    def work() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)

    orderly(signal.SIGTERM, work)


def test_other_errors_are_raised_and_reported_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    class Finalised:
        def __del__(self) -> None:
            raise ZeroDivisionError

    reported = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: reported.append(dropped.exc_type))
    with pytest.raises(ZeroDivisionError), orderly_stops():
        raise ZeroDivisionError(bool(Finalised()))
    assert reported == [ZeroDivisionError]


@of_every_kind
def test_a_stop_is_put_off(number: signal.Signals) -> None:
    done = []

    def work(stop: Put) -> None:
        for step in range(4):
            if step == 1:
                signal.raise_signal(number)
                signal.raise_signal(signal.SIGINT)
            done.append((step, stop.asked()))
            stop.follow()

    with pytest.raises(KINDS[number]), stops_put_off() as stop:
        work(stop)
    assert done == [(0, False), (1, True)]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, EXIT_TERMINATED), (signal.SIGHUP, EXIT_HUNG_UP)])
def test_without_a_command_a_stop_ends_the_process(number: signal.Signals, code: int, fork_server: ForkServer) -> None:
    """A program that trains without the command line ends as a terminated process does, without a traceback."""
    ended = fork_server.call("test_stops:stop_put_off", int(number))
    assert (ended.wait(), ended.stderr) == (code, "")


def stop_put_off(number: int) -> None:
    """Get a stop in the last step, which is not lost."""
    with stops_put_off():
        signal.raise_signal(number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_background_commands_go_on_ignoring_what_they_ignore(number: signal.Signals) -> None:
    """A shell lets commands in the background ignore Ctrl-C, and nohup lets them ignore a closed terminal."""
    signal.signal(number, signal.SIG_IGN)
    with orderly_stops(), stops_put_off() as stop:
        signal.raise_signal(number)
        assert not stop.asked()


def test_other_threads_leave_signals_alone() -> None:
    before, seen = signal.getsignal(signal.SIGTERM), []

    def work() -> None:
        with orderly_stops(), stops_put_off() as stop:
            seen.extend([signal.getsignal(signal.SIGTERM), stop.asked()])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before, False]
