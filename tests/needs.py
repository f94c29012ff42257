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
NO_THREE_VRM = "no @pixiv/three-vrm in web/node_modules"
NO_SPLAT_TRANSFORM = "no @playcanvas/splat-transform in web/node_modules"
NO_MOUNT = "no right to mount a small disk"
NO_NAMESPACE = "no right to make a network namespace"
NO_ENGINE = "no engine of clusters"
NO_TASKS_VISION = "no @mediapipe/tasks-vision in web/node_modules"

_OF_NODE = (NO_VALIDATOR, NO_THREE_VRM, NO_SPLAT_TRANSFORM, NO_TASKS_VISION)
_REMEDIES = {
    NO_ENGINE: "run `make batch-engines`; for Slurm, start one with tests/slurm_here.sh and set SLURM_CONF",
    NO_GPU: "run `make gpu` on a machine with an NVIDIA GPU and the CUDA toolkit",
    NO_TEST_DATA: "set MIEN_TEST_DATA to the folder that holds it",
    NO_MOUNT: "run the tests as root, in a container that may mount",
    NO_NAMESPACE: "run the tests on Linux where `unshare -rn true` works",
    IS_ROOT: "run the tests as another user",
    NO_PROC: "run them on Linux",
    NO_PACKAGE: "run `make setup`; some packages exist on some platforms only",
    NO_INSTRUCTIONS: "run them on one that has",
    **dict.fromkeys((NO_NODE_PACKAGES, *_OF_NODE), "run `make web-packages`"),
    NO_NODE: "install Node.js 20 or newer with npm, then run `make web-packages`",
    NO_CHROMIUM: "run `apt-get install chromium`, or set MIEN_CHROMIUM to a Chromium's path",
    NO_WEBGPU: "install Chromium 156 or newer, whose WebGPU can run in software",
    HAS_GPU: "run them with CUDA_VISIBLE_DEVICES=",
}
_EVERYWHERE = (NO_GPU, HAS_GPU, IS_ROOT, NO_MOUNT, NO_NAMESPACE, NO_INSTRUCTIONS, NO_ENGINE)
"""Reasons that lie in the machine alone. Others mean an incomplete set-up; MIEN_STRICT makes them an error."""
_AREAS = {
    "pages in a browser": (NO_CHROMIUM, NO_WEBGPU), "the web runtime": (NO_NODE, NO_NODE_PACKAGES, *_OF_NODE),
    "real footage": (NO_TEST_DATA,), "GPUs": (NO_GPU,),
}  # fmt: skip
"""Parts of the product that are not tested if tests are skipped for these reasons."""


def is_strict() -> bool:
    """Return whether tests may be skipped only for reasons that depend on the machine alone (MIEN_STRICT)."""
    return bool(os.environ.get("MIEN_STRICT"))


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
    """Say what was not tested, then count the skipped tests by reason: one line each, with the remedy."""
    counts = Counter(reason.removeprefix("Skipped: ") for reason in reasons)
    if not counts:
        return ["No test was skipped."]
    areas = [area for area, starts in _AREAS.items() if any(reason.startswith(starts) for reason in counts)]
    many = "1 test was" if counts.total() == 1 else f"{counts.total()} tests were"
    lines = [f"{many} skipped" + (f"; not tested: {', '.join(areas)}" if areas else "") + ":"]
    for reason, count in counts.most_common():
        remedy = next((f"; {remedy}" for start, remedy in _REMEDIES.items() if reason.startswith(start)), "")
        lines.append(f"{count:6}  {reason}{remedy}")
    return lines


def unexpected(reasons: Iterable[str]) -> list[str]:
    """Return the reasons that a complete set-up does not have, sorted."""
    plain = {reason.removeprefix("Skipped: ") for reason in reasons}
    return sorted(reason for reason in plain if not reason.startswith(_EVERYWHERE))
