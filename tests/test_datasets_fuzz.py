"""Random faults in every layout of a dataset: one line of complaint, or content that can be used.

`make fuzz-datasets` makes 2,000 in each layout. Nothing outside the output may change, and no pickle may run. Some are
damage to a file of any kind; others have a meaning: a missing camera, another FLAME (`fuzzing.dataset_faults`).
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from random import Random

import pytest

from capture_helpers import tree_bytes
from dataset_cases import LAYOUTS, Campaign, Outcome, make_quick
from fuzzing.dataset_faults import KINDS, faulty_dataset
from mien.errors import UserError

CASES, FIRST = (int(os.environ.get(f"MIEN_DATASET_FUZZ{name}", default)) for name, default in (("", 60), ("_FROM", 0)))
"""Number of cases of each layout, and the number of the first, to run some of them again."""
_SHOWN = 20
"""Most findings that a failure lists."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the networks and the capture of videos, and draw small pictures."""
    make_quick(monkeypatch)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("layout", LAYOUTS)
def test_damage_is_told_in_one_line(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    campaign, outcomes, start = Campaign(layout, tmp_path, capsys), {}, time.perf_counter()
    for number in range(FIRST, FIRST + CASES):
        outcomes[number] = campaign.run(number)
    findings = [f"{number} ({each.fault}): {each.wrong}" for number, each in outcomes.items() if each.wrong]
    _count(layout, list(outcomes.values()), len(findings), time.perf_counter() - start)
    again = "MIEN_DATASET_FUZZ=1 MIEN_DATASET_FUZZ_FROM=<number> repeats one"
    assert not findings, "\n".join([f"{layout}: {len(findings)} of {CASES} ({again})", *findings[:_SHOWN]])
    refused = sum(bool(each.complaint) for each in outcomes.values())
    assert CASES < 20 or refused > CASES / 5, "faults that nobody notices"


def _count(layout: str, outcomes: list[Outcome], findings: int, seconds: float) -> None:
    """Add a line of figures to the file that MIEN_DATASET_FUZZ_COUNTS names."""
    if "MIEN_DATASET_FUZZ_COUNTS" not in os.environ:
        return
    refused = sum(bool(each.complaint) for each in outcomes)
    line = {
        "layout": layout, "first": FIRST, "cases": len(outcomes), "refused": refused, "findings": findings,
        "imported": len(outcomes) - refused - findings, "seconds": round(seconds),
        "slowest": round(max(each.seconds for each in outcomes), 2),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10,
    }  # fmt: skip
    file = Path(os.environ["MIEN_DATASET_FUZZ_COUNTS"])
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a") as stream:
        stream.write(json.dumps(line) + "\n")


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("kind", KINDS)
def test_the_command_refuses_each_kind_of_fault(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A process of its own says what the functions say, in one line, and ends with 2. Nothing is left."""
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    campaign, root, canary, out = Campaign("vhap", tmp_path, capsys), *(tmp_path / name for name in ("a", "b", "out"))
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
            campaign.use(root, "tiny", tmp_path / f"out{number}", retrack=False)
        except UserError as error:
            complaint = str(error)
    before = tree_bytes(canary)
    line = ["-m", "mien.cli", "import", str(root), "--out", str(out), "--face-model", "tiny"]
    done = subprocess.run([sys.executable, *line], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    told = [each for each in done.stderr.splitlines() if each.startswith("mien: ")]
    assert len(told) == 1, done.stderr
    assert complaint == told[0].removeprefix("mien: ") or "is no dataset" in complaint
    assert "Traceback" not in done.stderr
    assert not list(out.glob("sequences/*"))
    assert tree_bytes(canary) == before
