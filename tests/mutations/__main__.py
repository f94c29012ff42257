"""Mutate the code, one mistake at a time, and run the tests that should catch it: `make mutate`."""

import argparse
import os
import random
import re
import shutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mutations.copies import Case, MutationError, Verdict, Workshop, read_cases

CAUGHT_SHARE = 0.95
"""Share of the mutations that the tests must catch."""


def main() -> int:
    """Try the mutations. The exit code is 1 if fewer than 95 % are caught, and 2 if one cannot be tried."""
    parser = argparse.ArgumentParser(prog="mutations", description=__doc__)
    parser.add_argument("--only", default="", metavar="TEXT", help="cases whose file or text has this")
    parser.add_argument("--workers", type=int, default=1, help="copies of the project that are mutated at once")
    parser.add_argument("--sample", type=int, default=None, metavar="N", help="try only N of them, drawn by --seed")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    cases = [case for case in read_cases() if asked.only in f"{case.file} {case.old}"]
    if not cases:
        parser.error(f"--only {asked.only}: no mutation has this in its file or text")
    if asked.sample is not None:
        cases = random.Random(asked.seed).sample(cases, min(asked.sample, len(cases)))
    folder = Path(tempfile.mkdtemp(prefix="mien-mutate-"))
    try:
        verdicts = _try_all(cases, folder, asked.workers)
    except MutationError as error:
        print(f"mutations: {error}", file=sys.stderr)
        return 2
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    caught = sum(verdict.caught for verdict in verdicts)
    print(f"{caught} of {len(verdicts)} mutations are caught ({100 * caught / len(verdicts):.1f} %).")
    for verdict in verdicts:
        if not verdict.caught:
            print(f"  survives: {verdict.case.file}: {verdict.case.old!r} -> {verdict.case.new!r}")
    return int(caught < CAUGHT_SHARE * len(verdicts))


def _try_all(cases: list[Case], folder: Path, workers: int) -> list[Verdict]:
    """Try the cases in `workers` copies of the project, and print a line for each."""
    free = [Workshop(folder / str(index)) for index in range(min(workers, len(cases)))]

    def attempt(case: Case) -> Verdict:
        workshop, began = free.pop(), time.monotonic()
        verdict = workshop.attempt(case)
        free.append(workshop)
        word, by = "caught" if verdict.caught else "SURVIVES", re.sub(r" - .*", "", verdict.by)
        print(f"{word:8} {time.monotonic() - began:4.0f} s  {case.file}: {case.new}  {by}", flush=True)
        return verdict

    with ThreadPoolExecutor(len(free)) as pool:
        return list(pool.map(attempt, cases))


if __name__ == "__main__":
    os.nice(5)
    sys.exit(main())
