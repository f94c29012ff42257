"""The summary of skipped tests names reason and remedy, strict runs fail for some, and calls of tests are checked."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from jaxtyping import TypeCheckError

from checked_types import unchecked
from mien.rotation import skew
from needs import IS_ROOT, NO_CHROMIUM, NO_GPU, NO_INSTRUCTIONS, NO_NODE, NO_TEST_DATA, skipped_lines, unexpected

TESTS = Path(__file__).parent


def test_skipped_tests_are_counted_by_reason_with_a_remedy() -> None:
    reasons = [f"Skipped: {NO_TEST_DATA}", IS_ROOT, NO_TEST_DATA, f"{NO_INSTRUCTIONS}avx512", "because"]
    assert skipped_lines(reasons) == [
        "5 tests were skipped; not tested: real footage:",
        "     2  no test data; set MIEN_TEST_DATA to the folder that holds it",
        "     1  root may write everywhere; run the tests as another user",
        "     1  this processor has no avx512; run them on one that has",
        "     1  because",
    ]
    assert skipped_lines([]) == ["No test was skipped."]
    assert unexpected([NO_GPU, f"Skipped: {NO_CHROMIUM}", NO_CHROMIUM, IS_ROOT, "because"]) == ["because", NO_CHROMIUM]


def test_a_strict_run_with_a_worker_fails(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text((TESTS / "conftest.py").read_text())
    (tmp_path / "test_one.py").write_text(f"import pytest\n\ndef test_skips():\n    pytest.skip({NO_NODE!r})\n")
    environment = {**os.environ, "MIEN_STRICT": "1", "PYTHONPATH": str(TESTS)}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "MIEN_STRICT is set" in done.stdout


def test_a_wrong_type_is_found_where_calls_are_checked() -> None:
    integers = torch.zeros(2, 3, dtype=torch.int64)
    with unchecked():
        skew(integers)
    with pytest.raises(TypeCheckError):
        skew(integers)
