"""Random faults in every layout of a dataset: one line of complaint, or content that can be used.

`make fuzz-datasets` makes 2,000 in each layout. Nothing outside the output may change, and no pickle may run. Some are
damage to a file of any kind; others have a meaning: a missing camera, another FLAME (`fuzzing.dataset_faults`).
"""

import os
import shutil
from pathlib import Path
from random import Random

import pytest

from capture_helpers import tree_bytes
from dataset_cases import LAYOUTS, Campaign, make_quick
from fuzzing.dataset_faults import KINDS, faulty_dataset
from mien.errors import UserError

pytestmark = pytest.mark.unchecked

CASES, FIRST = (int(os.environ.get(f"MIEN_DATASET_FUZZ{name}", default)) for name, default in (("", 0), ("_FROM", 0)))
"""Number of cases of each layout if it is not the usual one, and that of the first, to run some of them again."""
_SHOWN = 20
"""Most findings that a failure lists."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the networks and the capture of videos, and draw small pictures."""
    make_quick(monkeypatch)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("cases", [6, pytest.param(60, marks=pytest.mark.long)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_damage_is_told_in_one_line(
    layout: str, cases: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    campaign, cases = Campaign(layout, tmp_path, capsys), CASES or cases
    outcomes = {number: campaign.run(number) for number in range(FIRST, FIRST + cases)}
    findings = [f"{number} ({each.fault}): {each.wrong}" for number, each in outcomes.items() if each.wrong]
    again = "MIEN_DATASET_FUZZ=1 MIEN_DATASET_FUZZ_FROM=<number> repeats one"
    assert not findings, "\n".join([f"{layout}: {len(findings)} of {cases} ({again})", *findings[:_SHOWN]])
    refused = sum(bool(each.complaint) for each in outcomes.values())
    assert cases < 20 or refused > cases / 5, "faults that nobody notices"


@pytest.mark.usefixtures("quick")
def test_the_command_refuses_each_kind_of_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command says what the functions say, in one line, and ends with 2. Nothing is left."""
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    campaign, root, canary = Campaign("vhap", tmp_path, capsys), tmp_path / "a", tmp_path / "b"
    for kind in KINDS:
        complaint, number = "", 0
        while not complaint:  # some faults do no harm
            for place in (root, tmp_path / "a-aside", canary):
                shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(campaign.material, root)
            canary.mkdir()
            (canary / "file").write_text("a secret")
            faulty_dataset(root, canary, Random(number), kind)
            number += 1
            try:
                campaign.use(root, "tiny", tmp_path / f"{kind}{number}", retrack=False)
            except UserError as error:
                complaint = str(error)
        before, out = tree_bytes(canary), tmp_path / f"{kind} by the command"
        told = campaign.complaint_of(["import", str(root), "--out", str(out), "--face-model", "tiny"])
        assert complaint == told or "is no dataset" in complaint
        assert told
        assert not list(out.glob("sequences/*"))
        assert tree_bytes(canary) == before
