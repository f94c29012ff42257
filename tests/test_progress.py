"""Progress in a log file is a line now and then, and the last line once."""

import pytest

from mien import progress
from mien.progress import progress_bar


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now


def test_the_last_line_is_printed_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "_PLAIN_INTERVAL_SECONDS", 0.0)
    with progress_bar("Tracking", 2) as advance:
        advance(status="clip")
        advance(status="clip")
    assert capsys.readouterr().err.splitlines() == ["Tracking: 1/2 in 0 s; clip", "Tracking: 2/2 in 0 s; clip"]


def test_a_slow_first_item_does_not_count(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    with progress_bar("evaluate", 20) as advance:
        for seconds in (100.0, 10.0, 10.0, *[0.0] * 17):
            clock.now += seconds
            advance()
    assert capsys.readouterr().err.splitlines() == [
        "evaluate: 1/20 in 100 s",
        "evaluate: 2/20 in 110 s",
        "evaluate: 3/20 in 120 s, ETA 170 s",
        "evaluate: 20/20 in 120 s",
    ]
