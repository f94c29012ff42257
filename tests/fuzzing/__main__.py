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
from dataclasses import asdict
from pathlib import Path

from fuzzing import campaign
from fuzzing.material import make_material


def main() -> int:
    """Run the fuzzers. The exit code is 1 if something was found."""
    parser = argparse.ArgumentParser(prog="fuzzing", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=1500, help="mutated inputs over all targets")
    parser.add_argument("--minutes", type=float, default=None, help="go on with further seeds for so long")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=None, help="names of targets")
    parser.add_argument("--findings", type=Path, default=None, help="file of json lines for what is found")
    parser.add_argument("--replay", default=None, metavar="TARGET:SEED:NUMBER", help="one case, with all that is known")
    parser.add_argument("--self-check", action="store_true", help="first, find that whatever is wrong would be found")
    parser.add_argument("--keep", action="store_true", help="leave the faulty files and say where")
    asked = parser.parse_args()
    os.nice(5)
    memory = Path("/dev/shm")  # a thousand small folders are made and removed
    folder = Path(tempfile.mkdtemp(prefix="mien-fuzz-", dir=memory if memory.is_dir() else None))
    material = folder / "material"
    try:
        if (child := os.fork()) == 0:  # this process starts no threads, so that it forks safely
            make_material(material)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0, "the material could not be made"
        if asked.replay is not None:
            result = next(campaign.run_cases([asked.replay], folder / "worker", material))
            print(json.dumps(asdict(result), indent=1, ensure_ascii=True))
            return int(result.outcome == "finding")
        missed = campaign.missed(folder / "self", material) if asked.self_check else []
        until = None if asked.minutes is None else time.monotonic() + 60 * asked.minutes
        given = asked.seed, asked.cases, folder, material, asked.only, asked.workers, until, asked.findings
        results = campaign.run(*given)
        print(campaign.table_of(results), *(f"missed by the fuzzers: {one}" for one in missed), sep="\n")
        return int(bool(missed) or any(result.outcome == "finding" for result in results))
    finally:
        if asked.keep:
            print(f"the files are in {folder}", file=sys.stderr)
        else:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
