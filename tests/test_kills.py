"""Commands that are killed at random moments continue to the same bytes: `fuzzing.kills` with a few kills.

`make kills KILLS=200` does the same at length.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzzing.kills import STAGES, Tally
from fuzzing.same_bytes import differing_files

KILLS = 6
SECONDS = 900
"""Time limit for a busy machine. An idle one with two cores needs a minute and a half."""


@pytest.mark.slow
def test_random_kills_leave_nothing_to_do_by_hand(tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "fuzzing.kills", "--kills", str(KILLS), "--findings", str(tmp_path / "kills.jsonl")],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr[-3000:]}\n{(tmp_path / 'kills.jsonl').read_text()}"
    assert "| all | " in result.stdout


def test_other_bytes_are_found(tmp_path: Path) -> None:
    """The comparison sees every visible file; measured times, hidden files and checkpoints of a stop do not count."""
    one, other = tmp_path / "one", tmp_path / "other"
    for folder, seconds in ((one, 1.5), (other, 2.5)):
        (folder / "run/checkpoints").mkdir(parents=True)
        (folder / "run/training.json").write_text(f'{{"steps": 3, "seconds": {seconds}}}')
        (folder / "run/report.html").write_text(f"<b>{seconds} s</b> Peak memory {seconds} MB.")
        (folder / "run/film.mp4").write_bytes(b"film")
        (folder / f"run/checkpoints/step_{seconds}.safetensors").touch()
        (folder / f".{seconds}.lock").touch()
    assert differing_files(one, other) == []
    (other / "run/training.json").write_text('{"steps": 4, "seconds": 1.5}')
    (other / "run/report.html").write_text("<b>1.5 dB</b> Peak memory 1.5 MB.")
    (other / "run/film.mp4").write_bytes(b"filn")
    (other / "run/more").touch()
    assert differing_files(one, other) == ["run/more", "run/film.mp4", "run/report.html", "run/training.json"]


def test_the_table_counts_by_stage_and_signal() -> None:
    tally = Tally(findings=[{"stage": "train"}])
    tally.kills.update({("train", "SIGTERM"): 3, ("export", "SIGKILL"): 2})
    tally.chains.update({"train": 1, "export": 2})
    rows = tally.table().splitlines()
    assert len(rows) == len(STAGES) + 4
    assert "| train | 0 | 3 | 0 | 3 | 1 | 1 |" in rows
    assert "| all | 2 | 3 | 0 | 5 | 3 | 1 |" in rows
