"""The process of one row of a batch: it runs the row's steps as the command line would."""

import sys
from functools import partial
from pathlib import Path

from mien.batch.row import do_steps, row_process
from mien.cli import main

if __name__ == "__main__":
    sys.exit(row_process(Path(sys.argv[1]), sys.stdin, partial(do_steps, main)))
