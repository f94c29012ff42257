"""Random faults in every layout of a dataset: one line of complaint, or content that can be used.

`make fuzz-datasets` makes 2,000 in each layout. Nothing outside the output may change, and no pickle may run. Some are
damage to a file of any kind; others have a meaning: a missing camera, another FLAME (`fuzzing.dataset_faults`)."""

import os
from pathlib import Path

import pytest

from dataset_cases import LAYOUTS, Campaign, make_quick

pytestmark = pytest.mark.unchecked

CASES, FIRST = (int(os.environ.get(f"MIEN_DATASET_FUZZ{name}", default)) for name, default in (("", 0), ("_FROM", 0)))
"""Number of cases of each layout if it is not the usual one, and that of the first, to run some of them again."""
_SHOWN = 20
"""Most findings that a failure lists."""


@pytest.mark.parametrize("cases", [6, pytest.param(60, marks=pytest.mark.long)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_damage_is_told_in_one_line(layout: str, cases: int, tmp_path: Path, monkeypatch, capsys) -> None:
    make_quick(monkeypatch)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    campaign, cases = Campaign(layout, tmp_path, capsys), CASES or cases
    outcomes = {number: campaign.run(number) for number in range(FIRST, FIRST + cases)}
    findings = [f"{number} ({each.fault}): {each.wrong}" for number, each in outcomes.items() if each.wrong]
    again = "MIEN_DATASET_FUZZ=1 MIEN_DATASET_FUZZ_FROM=<number> repeats one"
    assert not findings, "\n".join([f"{layout}: {len(findings)} of {cases} ({again})", *findings[:_SHOWN]])
    refused = sum(bool(each.complaint) for each in outcomes.values())
    assert cases < 20 or refused > cases / 5, "faults that nobody notices"
