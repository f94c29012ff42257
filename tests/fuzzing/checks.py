"""Checks of the table of readers by the table of damage. Tests call them in processes of their own.

Each raises an error with a table of what was found, and with the command that repeats it.
"""

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import torch

from fuzzing import campaign
from fuzzing.campaign import run_cases, table_of
from fuzzing.judge import Result
from fuzzing.targets import TARGETS, present, spread
from fuzzing.values import SANE, VALUES, concrete, edit


def _run(cases: Iterable[str], folder: str, material: str) -> list[Result]:
    torch.set_num_threads(1)
    os.environ["MIEN_THREADS"] = "1"
    results = list(run_cases(list(cases), Path(folder), Path(material)))
    assert not any(result.outcome == "finding" for result in results), table_of(results)
    return results


def check_damage(folder: str, material: str, kind: str) -> None:
    """Check one kind of damage to the file of every reader. Readers of exact content refuse all of it.

    Only an analysis that is missing is made anew.
    """
    names = [
        name
        for name in present(Path(material))
        if "**" not in TARGETS[name].files and name not in ("names", "playlists")
    ]
    patterns = {name: TARGETS[name].files for name in names}
    amounts = {name: len(list(Path(material).glob(one))) if one.endswith("/*") else 1 for name, one in patterns.items()}
    cases = [f"{name}:{kind}:{number}" for name in names for number in range(min(amounts[name], 6))]
    results = _run(cases, folder, material)
    silent = [result.case for result in results if result.outcome != "refused"]
    silent = [case for case in silent if TARGETS[case.split(":")[0]].exact and case != "analysis.json:missing:0"]
    assert not silent, silent


def check_values(folder: str, material: str, name: str) -> None:
    """Check the values that the reader of one target must refuse, in each file that has such a place."""
    root, target = Path(material), TARGETS[name]
    files = list(enumerate(sorted(path for path in root.glob(target.files) if path.is_file())))
    files = files[-1:] if name == "checkpoints" else files
    cases = [
        f"{name}:{row}/{index}:{number}"
        for row, one in enumerate(VALUES[name])
        for number, file in files
        for index, (where, value) in enumerate(concrete(one, file))
        if edit(file, where, value) is not None
    ]
    refused = {result.case.split(":")[1].split("/")[0] for result in _run(cases, folder, material)
               if result.outcome == "refused"}  # fmt: skip
    missed = [one[0] for row, one in enumerate(VALUES[name]) if str(row) not in refused]
    assert not missed, f"no file has these places: {missed}"


def check_random(folder: str, material: str, seed: int, cases: int) -> None:
    """Check random faults of all readers. Some are refused and some accepted."""
    numbered = [case.format(seed=seed) for case in spread(cases, present(Path(material)))]
    outcomes = Counter(result.outcome for result in _run(numbered, folder, material))
    assert outcomes["refused"] > cases / 3, outcomes
    assert outcomes["accepted"] > cases / 10, outcomes


def check_repairs(folder: str, material: str) -> None:
    """Check that sane edits of files with checksums are accepted, once everything around them is corrected."""
    results = _run([f"{name}:sane:0" for name in SANE], folder, material)
    assert all(result.outcome == "accepted" for result in results), table_of(results)


def check_judge(folder: str, material: str) -> None:
    """Check that the judge finds readers that are wrong in every way."""
    missed = campaign.missed(Path(folder), Path(material))
    assert not missed, "\n".join(missed)
