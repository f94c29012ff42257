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


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    __call__ = monotonic


def pieces_of(frames: int, settings: TrainSettings = SETTINGS) -> list[Piece]:
    return expected_pieces([frames], count_scored([frames], ["me"], settings), TrackingSettings(), settings, "auto")


def work(pieces: list[Piece], clock: Clock, seconds: list[float]) -> Iterator[tuple[int, float, float]]:
    """Do pieces that take so long, and yield the stage, the moment and the remaining time after each tenth of each."""
    overall = Overall(pieces, clock)
    for piece, each in zip(pieces, seconds, strict=True):
        assert overall.begin(f"{piece.title} me", 0.0)
        for tenth in range(1, 11):
            clock.now += each / 10
            overall.advance(tenth / 10)
            yield overall.stage(), clock.now, overall.remaining()
        overall.end()


@pytest.mark.parametrize("slower", [1.0, 0.25, 6.0])
def test_the_estimate_converges(slower: float) -> None:
    """On a machine of any speed, the error shrinks: a quarter of all after the capture, a tenth in half of training."""
    clock, pieces = Clock(), pieces_of(1000)
    seconds = [slower * piece.seconds for piece in pieces]
    whole = sum(seconds)
    moments = list(work(pieces, clock, seconds))
    errors = [(stage, abs(now + left - whole) / whole) for stage, now, left in moments]
    for stage, most in ((2, 0.25), (3, 0.1), (4, 0.05)):
        assert max(error for at, error in errors if at == stage) < most, stage
    assert moments[-1][2] == 0.0


def test_a_method_that_takes_longer_is_noticed_while_it_trains() -> None:
    clock, pieces = Clock(), pieces_of(500)
    seconds = [piece.seconds * (5.0 if piece.stage == "training" else 1.0) for piece in pieces]
    whole = sum(seconds)
    errors = [abs(now + left - whole) / whole for stage, now, left in work(pieces, clock, seconds) if stage == 3]
    assert max(errors) < 0.25


def test_stages_come_in_order_and_current_ones_take_no_time() -> None:
    clock, pieces = Clock(), pieces_of(500)
    stages = [stage for stage, _, _ in work(pieces, clock, [1.0] * len(pieces))]
    assert all(before <= after for before, after in pairwise(stages))
    assert set(stages) == {1, 2, 3, 4}
    overall = Overall(pieces, clock)
    whole = overall.remaining()
    assert whole == pytest.approx(sum(piece.seconds for piece in pieces))
    assert overall.begin("training", 0.5)  # capture and tracking are current; the run resumes
    assert overall.stage() == 3
    assert overall.remaining() == pytest.approx(
        12_000 * 0.042 / 2 + sum(p.seconds for p in pieces if p.stage == "scoring")
    )
    clock.now += 100.0
    overall.advance(0.75)
    assert overall.remaining() == pytest.approx(100.0 + sum(p.seconds for p in pieces if p.stage == "scoring"))


def test_another_part_of_a_clip_is_the_same_piece_and_other_bars_do_not_count() -> None:
    overall = Overall(pieces_of(500), Clock())
    assert overall.begin("capture me-1", 0.0)
    overall.end()
    left = overall.remaining()
    assert overall.begin("capture me-2", 0.0)
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
    write_video(tmp_path / "a.mp4", (np.zeros((32, 32, 3), np.uint8) for _ in range(50)), 25.0)
    (tmp_path / "pictures").mkdir()
    for number in range(7):
        (tmp_path / "pictures" / f"{number}.png").touch()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    video = tmp_path / "a.mp4"
    assert count_captured(video, CaptureSettings()) == 50
    assert count_captured(video, CaptureSettings(start=0.4, end=1.6, stride=2)) == 15
    assert count_captured(video, CaptureSettings(max_frames=9)) == 9
    assert count_captured(tmp_path / "pictures", CaptureSettings()) == 7
    assert count_captured(tmp_path / "broken.mp4", CaptureSettings()) == 0


def test_a_bar_has_the_whole_command_beside_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "console", Console(file=sys.stderr, width=150, force_terminal=True))
    clock = Clock()
    with whole_command(Overall([Piece("capture", "capture ", 10.0), Piece("training", "training", 190.0)], clock)):
        with progress_bar("capture me", 2) as advance:
            clock.now += 5.0
            advance(status="sharp")
            advance()
        with progress_bar("decode", 1) as advance:
            advance(status="alone")
    shown = capsys.readouterr().err
    assert "sharp; all: stage 1 of 2, about 3 min" in shown
    assert "alone; all" not in shown


def test_a_log_has_a_line_at_each_stage_and_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    overall = Overall([Piece("capture", "capture ", 10.0), Piece("training", "training", 190.0)], clock)
    with whole_command(overall):
        with progress_bar("capture me", 1) as advance:
            clock.now += 10.0
            advance()
        with progress_bar("training", 4) as advance:
            for _ in range(4):
                clock.now += 70.0
                advance()
    with progress_bar("training", 1) as advance:
        advance()
    lines = [line for line in capsys.readouterr().err.splitlines() if "whole command" in line]
    assert lines == [
        "stage 1 of 2 (capture), about 3 min left of the whole command",
        "stage 2 of 2 (training), about 3 min left of the whole command",
        "stage 2 of 2 (training), about 4 min left of the whole command",
        "stage 2 of 2 (training), about 2 min left of the whole command",
        "stage 2 of 2 (training), about 70 s left of the whole command",
        "stage 2 of 2 (training), less than 10 s left of the whole command",
    ]


def test_the_last_line_is_printed_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    with progress_bar("Tracking", 2) as advance:
        for _ in range(2):
            clock.now += 10.0
            advance(status="clip")
    assert capsys.readouterr().err.splitlines() == ["Tracking: 1/2 in 10 s; clip", "Tracking: 2/2 in 20 s; clip"]


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
