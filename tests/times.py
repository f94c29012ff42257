"""Where the time of the tests goes, by theme: seconds, those that wait for other processes, and how many are started.

As a plugin of pytest it appends a line of json for each test to the file that MIEN_TEST_TIMES names. As a program it
prints the table. `make test-times` does both."""

import json
import os
import re
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

THEMES = {
    "pages, browser, viewer, web packages": "web|viewer|glb",
    "processes, commands, recipes": "two_commands|plugins|startup|cli|stops|terminal|end_to_end|batch",
    "damage, fuzz, full disks, odd command lines": "damage|fuzz|hostile|odd_|inside|exhaust|bad_input|native_calls|"
    "edges_of|locks",
    "tracking, alignment, drawn people": "track(?!ed)|alignment|eyelids|synthetic|mesh|photometric",
    "face models": "face|flame|gnm|ict",
    "capture, cameras, driving": "capture|video|color|camera|driv|motion|recordings|changing_pictures",
    "datasets": "dataset|named_split",
    "evaluation, reports, lab": "evaluation|analysis|study|bench|metrics",
    "docs, settings, presets": "docs|settings|paper_preset|release|seams",
    "training, avatars, rasterizer": "",
}
_starts = [0]


def pytest_configure() -> None:
    """Count the processes that are started."""
    sys.addaudithook(lambda event, _: _starts.__setitem__(0, _starts[0] + (event == "subprocess.Popen")))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Record the test with its fixtures."""
    began, computed, starts = time.monotonic(), time.process_time(), _starts[0]
    yield
    wall, own = time.monotonic() - began, time.process_time() - computed
    started = _starts[0] - starts
    with Path(os.environ["MIEN_TEST_TIMES"]).open("a") as file:
        file.write(json.dumps([item.nodeid, wall, max(wall - own, 0) if started else 0, started]) + "\n")


def main(path: str) -> None:
    """Print the table by theme, and the tests that take longest."""
    sums: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0, 0])
    rows = [json.loads(line) for line in Path(path).read_text().splitlines()]
    for name, *numbers in rows:
        stem = Path(name.partition("::")[0]).stem.removeprefix("test_")
        theme = next(theme for theme, pattern in THEMES.items() if re.search(pattern, stem))
        sums[theme] = [total + number for total, number in zip(sums[theme], (1, *numbers), strict=True)]
    print("| theme | tests | s | of this, waiting for processes | processes |\n|---|---|---|---|---|")
    for theme, (count, wall, waits, starts) in sorted(sums.items(), key=lambda entry: -entry[1][1]):
        print(f"| {theme} | {count:,.0f} | {wall:,.0f} | {waits:,.0f} | {starts:,.0f} |")
    print(*(f"\n{wall:6.1f} s  {name}" for name, wall, *_ in sorted(rows, key=lambda row: -row[1])[:20]), sep="")


if __name__ == "__main__":
    main(sys.argv[1])
