"""Keep mediapipe quiet: its native libraries write to standard error, and its Python part warns."""

import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_NOISE = re.compile(
    rb"^(INFO: Created TensorFlow Lite|WARNING: All log messages before absl|[IW]\d{4} \d\d:\d\d:\d\d|[IW]0000 )"
)


@contextmanager
def quiet_mediapipe() -> Iterator[None]:
    """Drop mediapipe's messages from standard error. All other lines are passed on at the end.

    Use it when graphs are built and process their first picture. Their native code writes to the file descriptor.
    """
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with tempfile.TemporaryFile() as chatter, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # protobuf's deprecations, in code that is not ours
            os.dup2(chatter.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(saved, 2)
                chatter.seek(0)
                for line in chatter:
                    if not _NOISE.match(line):
                        os.write(2, line)
    finally:
        os.close(saved)


def load_solution(name: str) -> Any:
    """Return one of mediapipe's `solutions` modules. The import is late because it takes over a second."""
    with quiet_mediapipe():
        from mediapipe.python import solutions

        return getattr(solutions, name)
