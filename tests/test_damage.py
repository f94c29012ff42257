"""Every reader meets every kind of damage: one line of complaint that names the file, or content that can be used.

The readers are the table `fuzzing.targets`, the damage is `fuzzing.faults`, `formats` and `values`, and the judge is
`fuzzing.judge`: no traceback, no hang, no memory beyond a bound, no byte outside. `make fuzz` draws from these tables.
Cases run in other processes, so that a crashing decoder spares the tests."""

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest
import torch

from forked import ForkServer
from fuzzing import campaign
from fuzzing.faults import FIXED
from fuzzing.judge import Result
from fuzzing.material import make_material
from fuzzing.targets import TARGETS, present, spread
from fuzzing.values import SANE, VALUES, concrete, edit
from shared_things import MadeOnce

# A missing analysis is made, and few runs have gains.
MAY_BE_MISSING = ("analysis.json:missing:0", "gains:missing:0")
CHECKS = {
    **{f"damage: {kind}": ("check_damage", kind) for kind in FIXED},
    **{f"values: {name}": ("check_values", name) for name in VALUES},
    "random": ("check_random", 0, 150), "repairs": ("check_repairs",), "judge": ("check_judge",),
}  # fmt: skip


@pytest.mark.parametrize("name", CHECKS)
def test_every_reader_by_every_damage(name: str, fork_server: ForkServer, tmp_path: Path, made_once: MadeOnce) -> None:
    """A check ends with a table of what was found, and with the command that repeats it."""
    check, *arguments = CHECKS[name]
    material = made_once("material", lambda folder: make_material(folder, whole=False))
    process = fork_server.call(f"test_damage:{check}", str(tmp_path / "b"), str(material), *arguments)
    assert process.wait() == 0, process.stdout + process.stderr[-6000:]


def results_of(cases: Iterable[str], folder: str, material: str) -> list[Result]:
    torch.set_num_threads(1)
    os.environ["MIEN_THREADS"] = "1"
    results = list(campaign.run_cases(list(cases), Path(folder), Path(material)))
    assert not any(result.outcome == "finding" for result in results), campaign.table_of(results)
    return results


def check_damage(folder: str, material: str, kind: str) -> None:
    """Damage the file of every reader. Readers of exact content refuse it, unless a file may be missing."""
    names = [name for name in present(Path(material)) if "**" not in TARGETS[name].files]
    cases = []
    for name in names:
        files = TARGETS[name].files
        amount = len(list(Path(material).glob(files))) if files.endswith("/*") else 1
        cases += [f"{name}:{kind}:{number}" for number in range(min(amount, 6))]
    silent = [result.case for result in results_of(cases, folder, material) if result.outcome != "refused"]
    silent = [case for case in silent if TARGETS[case.split(":")[0]].exact and case not in MAY_BE_MISSING]
    assert not silent, silent


def check_values(folder: str, material: str, name: str) -> None:
    """Put values that the reader must refuse into each file with such a place. Its checksum is right, or there is none.
    Whoever makes a file can make its checksum."""
    files = list(enumerate(sorted(path for path in Path(material).glob(TARGETS[name].files) if path.is_file())))
    cases = [
        f"{name}:{row}/{index}:{number}"
        for row, one in enumerate(VALUES[name])
        for number, file in (files[-1:] if name == "checkpoints" else files)
        for index, (where, value) in enumerate(concrete(one, file))
        if edit(file, where, value) is not None
    ]
    results = results_of(cases, folder, material)
    refused = {result.case.split(":")[1].split("/")[0] for result in results if result.outcome == "refused"}
    missed = [one[0] for row, one in enumerate(VALUES[name]) if str(row) not in refused]
    assert not missed, f"no file has these places: {missed}"


def check_random(folder: str, material: str, seed: int, cases: int) -> None:
    numbered = [case.format(seed=seed) for case in spread(cases, present(Path(material)))]
    outcomes = Counter(result.outcome for result in results_of(numbered, folder, material))
    assert outcomes["refused"] > cases / 3, outcomes
    assert outcomes["accepted"] > cases / 10, outcomes


def check_repairs(folder: str, material: str) -> None:
    """Edits that are sane are accepted, once all checksums around them are corrected: these would hide faults."""
    results = results_of([f"{name}:sane:0" for name in SANE], folder, material)
    assert all(result.outcome == "accepted" for result in results), campaign.table_of(results)


def check_judge(folder: str, material: str) -> None:
    """The judge finds readers that are wrong in every way."""
    missed = campaign.missed(Path(folder), Path(material))
    assert not missed, "\n".join(missed)
