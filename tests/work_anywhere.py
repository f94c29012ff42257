"""Train a toy and capture a clip. A test runs this in odd places; names come as arguments in any encoding."""

import os
import sys
from pathlib import Path

from mien.cli import main
from toy_workspace import write_toy_workspace


def work(place: Path, clip: Path | None) -> None:
    """Write into `place` a toy workspace and a capture of the clip's first frames."""
    write_toy_workspace(place / "toy")
    if clip is not None:
        options = ["--capture.size", "96", "--capture.max-frames", "3"]
        assert main(["capture", str(clip), "--out", str(place / "captured"), *options]) == 0


if __name__ == "__main__":
    if os.environ.get("ONE_CORE"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"working in {sys.argv[1]}")
    work(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
