"""The summary of skipped tests names reason and remedy, and strict runs fail where a set-up is not complete."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import conftest
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
    assert skipped_lines([IS_ROOT])[0] == "1 test was skipped:"


def test_the_first_line_says_what_was_not_tested() -> None:
    line = skipped_lines([NO_NODE, NO_GPU, NO_CHROMIUM])[0]
    assert line == "3 tests were skipped; not tested: pages in a browser, the web runtime, GPUs:"


def test_only_the_machine_excuses_a_skip() -> None:
    assert unexpected([NO_GPU, IS_ROOT, f"Skipped: {NO_INSTRUCTIONS}avx512"]) == []
    assert unexpected([NO_GPU, f"Skipped: {NO_CHROMIUM}", NO_CHROMIUM, "because"]) == ["because", NO_CHROMIUM]


@pytest.mark.parametrize(
    ("reason", "strict", "fails"), [(NO_NODE, "", False), (NO_NODE, "1", True), (NO_GPU, "1", False)]
)
def test_a_skip_fails_a_strict_run_where_a_program_is_missing(
    monkeypatch: pytest.MonkeyPatch, reason: str, strict: str, fails: bool
) -> None:
    monkeypatch.setenv("MIEN_STRICT", strict)
    reporter = SimpleNamespace(stats={"skipped": [SimpleNamespace(longrepr=("file", 1, f"Skipped: {reason}"))]})
    config = SimpleNamespace(pluginmanager=SimpleNamespace(get_plugin=lambda name: reporter))
    session = SimpleNamespace(config=config, exitstatus=pytest.ExitCode.OK)
    conftest.pytest_sessionfinish(session)  # type: ignore[arg-type]
    assert (session.exitstatus == pytest.ExitCode.TESTS_FAILED) == fails


def test_a_strict_run_with_a_worker_fails(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text((TESTS / "conftest.py").read_text())
    (tmp_path / "test_one.py").write_text(f"import pytest\n\ndef test_skips():\n    pytest.skip({NO_NODE!r})\n")
    environment = {**os.environ, "MIEN_STRICT": "1", "PYTHONPATH": str(TESTS)}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "MIEN_STRICT is set" in done.stdout
