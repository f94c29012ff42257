"""Shared fixtures; says at the end which tests lacked their data or device."""

import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
# The same examples on every machine, however busy it is.
settings.register_profile("mien", deadline=None, derandomize=True)
settings.load_profile("mien")


def _test_data() -> Path | None:
    named = os.environ.get("MIEN_TEST_DATA")
    folder = Path(named) if named else Path(__file__).parent.parent.parent / "shared" / "data"
    return folder if (folder / "MANIFEST.md").is_file() else None


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder named by MIEN_TEST_DATA (default: ../shared/data beside the checkout)."""
    folder = _test_data()
    if folder is None:
        pytest.skip("no test data: set MIEN_TEST_DATA")
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reasons = [str(report.longrepr) for report in terminalreporter.stats.get("skipped", [])]
    no_data = sum("no test data" in reason for reason in reasons)
    no_gpu = sum("no CUDA device" in reason for reason in reasons)
    terminalreporter.write_line(
        f"test data: {_test_data() and 'found' or 'MISSING, ' + str(no_data) + ' tests skipped'}; "
        f"CUDA: {'found' if torch.cuda.is_available() else 'none, ' + str(no_gpu) + ' tests skipped'}"
    )
