"""Progress in a bar and in a log, and the remaining time of a whole command, on a clock that the test sets."""

import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from mien import progress
from mien.capture import CaptureSettings
from mien.capture.video import write_video
from mien.commands.stages.expected import count_captured, count_scored, expected_pieces
from mien.overall import Overall, Piece
from mien.progress import progress_bar, whole_command
from mien.tracking import TrackingSettings
from mien.training import TrainSettings

SETTINGS = TrainSettings(steps=12_000)
TWO = [Piece("capture", "capture ", 10.0), Piece("training", "training", 190.0)]


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    __call__ = monotonic


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def pieces_of(frames: int, settings: TrainSettings = SETTINGS) -> list[Piece]:
    return expected_pieces([frames], count_scored([frames], ["me"], settings), TrackingSettings(), settings, "auto")


def work(pieces: list[Piece], seconds: list[float]) -> Iterator[tuple[int, float, float]]:
    """Do pieces that take so long, and yield the stage, the moment and the remaining time after each tenth of each."""
    clock = Clock()
    overall = Overall(pieces, clock)
    for piece, each in zip(pieces, seconds, strict=True):
        assert overall.begin(f"{piece.title} me", 0.0)
        for tenth in range(1, 11):
            clock.now += each / 10
            overall.advance(tenth / 10)
            yield overall.stage(), clock.now, overall.remaining()
        overall.end()


@pytest.mark.parametrize(("frames", "slower", "most"), [
    (1000, {}, {2: 0.25, 3: 0.1, 4: 0.05}),
    (1000, dict.fromkeys(("capture", "tracking", "training", "scoring"), 0.25), {2: 0.25, 3: 0.1, 4: 0.05}),
    (1000, dict.fromkeys(("capture", "tracking", "training", "scoring"), 6.0), {2: 0.25, 3: 0.1, 4: 0.05}),
    (500, {"training": 5.0}, {3: 0.25}),
])  # fmt: skip
def test_the_estimate_converges(frames: int, slower: dict[str, float], most: dict[int, float]) -> None:
    """The error shrinks on machines of any speed, and a method that takes longer is noticed while it trains."""
    pieces = pieces_of(frames)
    seconds = [slower.get(piece.stage, 1.0) * piece.seconds for piece in pieces]
    whole = sum(seconds)
    moments = list(work(pieces, seconds))
    errors = [(stage, abs(now + left - whole) / whole) for stage, now, left in moments]
    for stage, bound in most.items():
        assert max(error for at, error in errors if at == stage) < bound, stage
    assert moments[-1][2] == 0.0
    stages = [stage for stage, *_ in moments]
    assert all(before <= after for before, after in pairwise(stages))
    assert set(stages) == {1, 2, 3, 4}


def test_current_stages_take_no_time_and_other_bars_do_not_count() -> None:
    clock, pieces = Clock(), pieces_of(500)
    scoring = sum(piece.seconds for piece in pieces if piece.stage == "scoring")
    overall = Overall(pieces, clock)
    assert overall.remaining() == pytest.approx(sum(piece.seconds for piece in pieces))
    assert overall.begin("training", 0.5)  # capture and tracking are current; the run resumes
    assert overall.stage() == 3
    assert overall.remaining() == pytest.approx(12_000 * 0.042 / 2 + scoring)
    clock.now += 100.0
    overall.advance(0.75)
    assert overall.remaining() == pytest.approx(100.0 + scoring)
    overall = Overall(pieces, Clock())
    assert overall.begin("capture me-1", 0.0)
    overall.end()
    left = overall.remaining()
    assert overall.begin("capture me-2", 0.0), "another part of a clip is the same piece"
    overall.end()
    assert (overall.stage(), overall.remaining()) == (1, pytest.approx(left, rel=0.05))
    assert not overall.begin("decode me-1", 0.0)
    assert not overall.begin("find the face in me.mp4", 0.0), "time does not run backwards"
    assert overall.stage() == 1


def test_pieces_follow_the_settings() -> None:
    assert {piece.stage for piece in pieces_of(100, TrainSettings(split="none"))} == {"capture", "tracking", "training"}
    without = expected_pieces([100, 50], 0, TrackingSettings(schedule="landmarks"), SETTINGS, "none")
    assert not {"Overlay", "Fitting to pixels"} & {piece.title for piece in without}
    assert sum(piece.title == "Scoring masks" for piece in without) == 2
    assert count_scored([100, 50], ["a", "b"], TrainSettings(held_out_sequences=("b",), split="none")) == 50
    assert count_scored([100, 50], ["a", "b"], TrainSettings(held_out_sequences=("b",))) == 70


def test_frames_are_counted_as_the_settings_take_them(tmp_path: Path) -> None:
    video, pictures, broken = tmp_path / "a.mp4", tmp_path / "pictures", tmp_path / "broken.mp4"
    write_video(video, (np.zeros((32, 32, 3), np.uint8) for _ in range(50)), 25.0)
    pictures.mkdir()
    for number in range(7):
        (pictures / f"{number}.png").touch()
    broken.write_bytes(b"no video")
    part = CaptureSettings(start=0.4, end=1.6, stride=2)
    assert [count_captured(each, CaptureSettings()) for each in (video, pictures, broken)] == [50, 7, 0]
    assert [count_captured(video, each) for each in (part, CaptureSettings(max_frames=9))] == [15, 9]


def test_a_bar_has_the_whole_command_beside_it(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "console", Console(file=sys.stderr, width=150, force_terminal=True))
    clock = Clock()
    with whole_command(Overall(TWO, clock)):
        with progress_bar("capture me", 2) as advance:
            clock.now += 5.0
            advance(status="sharp")
            advance()
        with progress_bar("decode", 1) as advance:
            advance(status="alone")
    shown = capsys.readouterr().err
    assert "sharp; all: stage 1 of 2, about 3 min" in shown
    assert "alone; all" not in shown


def test_a_log_has_a_line_at_each_stage_and_now_and_then(clock: Clock, capsys) -> None:
    with whole_command(Overall(TWO, clock)):
        with progress_bar("capture me", 1) as advance:
            clock.now += 10.0
            advance()
        with progress_bar("training", 4) as advance:
            for _ in range(4):
                clock.now += 70.0
                advance()
    with progress_bar("training", 1) as advance:
        advance()
    ending = " left of the whole command"
    lines = [line.removesuffix(ending) for line in capsys.readouterr().err.splitlines() if line.endswith(ending)]
    assert lines == [
        "stage 1 of 2 (capture), about 3 min",
        "stage 2 of 2 (training), about 3 min",
        "stage 2 of 2 (training), about 4 min",
        "stage 2 of 2 (training), about 2 min",
        "stage 2 of 2 (training), about 70 s",
        "stage 2 of 2 (training), less than 10 s",
    ]


@pytest.mark.parametrize(("durations", "status", "told"), [
    ([10.0, 10.0], "clip", ["1/2 in 10 s; clip", "2/2 in 20 s; clip"]),
    (
        [100.0, 10.0, 10.0, *[0.0] * 17], "",
        ["1/20 in 100 s", "2/20 in 110 s", "3/20 in 120 s, ETA 170 s", "20/20 in 120 s"],
    ),
])  # fmt: skip
def test_a_slow_first_item_does_not_count_and_the_last_line_comes_once(
    durations: list[float], status: str, told: list[str], clock: Clock, capsys
) -> None:
    with progress_bar("Tracking", len(durations)) as advance:
        for seconds in durations:
            clock.now += seconds
            advance(status=status)
    assert capsys.readouterr().err.splitlines() == [f"Tracking: {each}" for each in told]
