"""Fuzz the readers: `PYTHONPATH=tests python -m fuzzing --cases 1500`, or `--minutes 30`; `--replay CASE` shows one."""

import os

# Set before numpy and torch are imported: cases are forked, and threads do not survive a fork.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MIEN_THREADS="1")

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

from fuzzing import campaign


def main() -> int:
    """Run the fuzzers. The exit code is 1 if something was found."""
    parser = argparse.ArgumentParser(prog="fuzzing", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=1500, help="mutated inputs over all targets")
    parser.add_argument("--lines", type=int, default=0, help="odd command lines besides")
    parser.add_argument(
        "--heavy", type=int, default=0, help="odd command lines of what takes long: each is stopped after 40 s"
    )
    parser.add_argument("--viewer", type=int, default=0, help="hostile messages to a running viewer")
    parser.add_argument("--minutes", type=float, default=None, help="go on with further seeds for so long")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=None, help="names of targets")
    parser.add_argument("--by-target", action="store_true", help="print a row for each target, not for each format")
    parser.add_argument("--findings", type=Path, default=None, help="file of json lines for what is found")
    parser.add_argument(
        "--replay", default=None, metavar="TARGET:SEED:NUMBER", help="one case, with all that is known of it"
    )
    parser.add_argument("--self-check", action="store_true", help="first, find that whatever is wrong would be found")
    parser.add_argument("--keep", action="store_true", help="of a replay: leave the faulty files and say where")
    asked = parser.parse_args()
    os.nice(5)
    memory = Path("/dev/shm")  # a thousand small folders are made and removed
    folder = Path(tempfile.mkdtemp(prefix="mien-fuzz-", dir=memory if memory.is_dir() else None))
    try:
        if asked.replay is not None:
            result = campaign.replay(asked.replay, folder)
            print(json.dumps(result.as_json(), indent=1, ensure_ascii=True))
            return int(result.outcome == "finding")
        until = None if asked.minutes is None else time.monotonic() + 60 * asked.minutes
        plan = campaign.Plan(
            asked.seed, asked.cases, asked.only, asked.workers, until, asked.lines, asked.heavy, asked.viewer,
            asked.self_check,
        )  # fmt: skip
        tally = campaign.run(plan, folder, asked.findings)
        print(tally.table(asked.by_target))
        for missed in tally.missed:
            print(f"missed by the fuzzers: {missed}")
        return int(bool(tally.findings or tally.missed))
    finally:
        if asked.keep:
            print(f"the files are in {folder}", file=sys.stderr)
        else:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
