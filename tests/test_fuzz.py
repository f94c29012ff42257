"""Mutated files and odd command lines cause one line of complaint or sound content.

They never cause a crash, a hang, a traceback or a byte outside. `tests/fuzzing` has the mutators and the judge;
`make fuzz MINUTES=30` runs the same at length.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPLAY = "one again: PYTHONPATH=tests .venv/bin/python -m fuzzing --replay CASE"
SECONDS = 400
"""Time limit for a busy machine. An idle one with two cores needs half a minute."""


@pytest.mark.slow
def test_random_damage_to_every_file(tmp_path: Path) -> None:
    """Random damage to any file does no harm.

    Cases run in other processes, so that a crashing decoder spares the tests.
    """
    asked = ("--self-check", "--seed", "0", "--cases", "750", "--lines", "20", "--workers", "2")
    result = subprocess.run(
        [sys.executable, "-m", "fuzzing", *asked, "--findings", str(tmp_path / "findings.jsonl")],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    told = f"{result.stdout}\n{result.stderr[-3000:]}\none again: PYTHONPATH=tests python -m fuzzing --replay CASE"
    assert result.returncode == 0, told
    assert "| all | 7" in result.stdout, told
