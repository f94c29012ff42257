"""Things that tests need and a machine may lack: the reason for a skip, and the remedy that makes the test run."""

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

from mien import _native

NO_GPU = "no CUDA device"
NO_TEST_DATA = "no test data"
IS_ROOT = "root may write everywhere"
NO_PROC = "no /proc"
NO_PACKAGE = "could not import"
NO_INSTRUCTIONS = "this processor has no "
HAS_GPU = "there is a GPU"
NO_NODE = "no Node.js"
NO_NODE_PACKAGES = "no packages in web/node_modules"
NO_CHROMIUM = "no Chromium"
NO_WEBGPU = "Chromium has no adapter of WebGPU"
NO_VALIDATOR = "no gltf-validator in web/node_modules"
NO_SPLAT_TRANSFORM = "no @playcanvas/splat-transform in web/node_modules"
NO_TASKS_VISION = "no @mediapipe/tasks-vision in web/node_modules"

_REMEDIES = {
    NO_GPU: "run `make gpu` on a machine with an NVIDIA GPU and the CUDA toolkit",
    NO_TEST_DATA: "set MIEN_TEST_DATA to the folder that holds it",
    IS_ROOT: "run the tests as another user",
    NO_PROC: "run them on Linux",
    NO_PACKAGE: "run `make setup`; some packages exist on some platforms only",
    NO_INSTRUCTIONS: "run them on one that has",
    NO_NODE_PACKAGES: "run `make web-packages`",
    NO_VALIDATOR: "run `make web-packages`",
    NO_SPLAT_TRANSFORM: "run `make web-packages`",
    NO_TASKS_VISION: "run `make web-packages`",
    NO_NODE: "install Node.js 20 or newer with npm, then run `make web-packages`",
    NO_CHROMIUM: "run `apt-get install chromium`, or set MIEN_CHROMIUM to a Chromium's path",
    NO_WEBGPU: "install Chromium 156 or newer, whose WebGPU can run in software",
    HAS_GPU: "run them with CUDA_VISIBLE_DEVICES=",
}


def find_test_data() -> Path | None:
    """Return the folder that MIEN_TEST_DATA names, or else shared/data beside the checkout, if it exists."""
    named = os.environ.get("MIEN_TEST_DATA")
    folder = Path(named) if named else Path(__file__).parent.parent.parent / "shared" / "data"
    return folder if (folder / "MANIFEST.md").is_file() else None


def use_instructions(isa: str) -> None:
    """Let the native core use that instruction set, or skip the test if the processor lacks it."""
    if not _native.set_rasterize_isa(isa):
        pytest.skip(NO_INSTRUCTIONS + isa)


def skipped_lines(reasons: Iterable[str]) -> list[str]:
    """Count the skipped tests by reason, one line each, with the remedy if there is one."""
    counts = Counter(reason.removeprefix("Skipped: ") for reason in reasons)
    if not counts:
        return ["No test was skipped."]
    lines = [f"{counts.total()} tests were skipped:"]
    for reason, count in counts.most_common():
        remedy = next((f"; {remedy}" for start, remedy in _REMEDIES.items() if reason.startswith(start)), "")
        lines.append(f"{count:6}  {reason}{remedy}")
    return lines
