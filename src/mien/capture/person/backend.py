"""Choice of the library that runs the networks for faces, landmarks and people: mediapipe or ai-edge-litert."""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, Literal

DetectorChoice = Literal["auto", "mediapipe", "litert"]
"""The choices of a user. auto is mediapipe where it is installed, and otherwise litert."""
Detector = Literal["mediapipe", "litert"]
MODULE_OF: dict[Detector, str] = {"mediapipe": "mediapipe", "litert": "ai_edge_litert"}


def choose_detector(choice: DetectorChoice = "auto") -> Detector:
    """Return the detector that runs: for `auto`, mediapipe where it is installed, and otherwise litert.

    Raises:
        ModuleNotFoundError: its package is not installed. `mien.plugins` says which extra brings it.
    """
    if choice == "auto":
        choice = "litert" if find_spec("mediapipe") is None else "mediapipe"
    if find_spec(MODULE_OF[choice]) is None:
        raise ModuleNotFoundError(f"No module named '{MODULE_OF[choice]}'", name=MODULE_OF[choice])
    return choice


def detector_entry(detector: Detector) -> dict[str, str]:
    """Return what a capture's `source` says about its detector. Captures by mediapipe say nothing."""
    return {} if detector == "mediapipe" else {"detector": detector}


def detector_of(source: Mapping[str, Any]) -> Detector:
    """Return the detector that found the landmarks of a capture with this `source`."""
    return "litert" if source.get("detector") == "litert" else "mediapipe"
