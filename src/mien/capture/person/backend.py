"""Choice of the library that runs the networks for faces, landmarks and people: mediapipe or ai-edge-litert."""

import os
import re
import sys
import tempfile
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from typing import Any, Literal, TypeVar

DetectorChoice = Literal["auto", "mediapipe", "litert"]
"""The choices of a user. auto is mediapipe where it is installed, and otherwise litert."""
Detector = Literal["mediapipe", "litert"]
FoundBy = Literal["mediapipe", "litert", "other"]
"""The program that found the landmarks of a capture. other: another program found the 68 points of 300-W."""
MODULE_OF: dict[Detector, str] = {"mediapipe": "mediapipe", "litert": "ai_edge_litert"}
_NOISE = re.compile(
    rb"^(INFO: Created TensorFlow Lite|WARNING: All log messages before absl|[IW]\d{4} \d\d:\d\d:\d\d|[IW]0000 )"
)


def choose_detector(choice: DetectorChoice = "auto") -> Detector:
    """Return the detector that runs: for `auto`, mediapipe where it is installed, and otherwise litert."""
    if choice == "auto":
        choice = "litert" if find_spec("mediapipe") is None else "mediapipe"
    if find_spec(MODULE_OF[choice]) is None:
        raise ModuleNotFoundError(f"No module named '{MODULE_OF[choice]}'", name=MODULE_OF[choice])
    return choice


def detector_entry(detector: FoundBy) -> dict[str, str]:
    """Return what a capture's `source` says about its detector. Captures by mediapipe say nothing."""
    return {} if detector == "mediapipe" else {"detector": detector}


def detector_of(source: Mapping[str, Any]) -> FoundBy:
    """Return the detector that found the landmarks of a capture with this `source`."""
    found = source.get("detector")
    return found if found in ("litert", "other") else "mediapipe"


_Opened = TypeVar("_Opened", bound="Networks")


class Networks(ABC):
    """Networks that are open in a `with` block, run by the library that `detector` chooses."""

    def __init__(self, detector: DetectorChoice = "auto") -> None:
        self._detector: DetectorChoice = detector

    def __enter__(self: _Opened) -> _Opened:
        self._stack = ExitStack()
        self._open(choose_detector(self._detector) == "mediapipe")
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @abstractmethod
    def _open(self, by_mediapipe: bool) -> None:
        """Open the networks. `_stack` closes what is entered or registered there."""


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
