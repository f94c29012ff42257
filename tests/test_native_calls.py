"""Native functions refuse arguments that do not belong together, and survive a lack of memory (`native_cases.py`)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mien import _native

TYPE, VALUE, INDEX, MEMORY = "TypeError", "ValueError", "IndexError", "MemoryError"
EXPECTED = {
    "short view": (TYPE, "RasterizeView has 7 items, not 6"),
    "short group in a view": (TYPE, "GaussianArrays has 5 items, not 1"),
    "group of other types": (TYPE, "FaceArrays.joint_rest has the wrong type or shape"),
    "group without an array": (TYPE, "LocalGaussians.log_scales has the wrong type or shape"),
    "group of a group": (TYPE, "Fragments.depth has the wrong type or shape"),
    "list for a group": (TYPE, "pose_face()"),
    "no group": (TYPE, "pose_face()"),
    "empty view backward": (TYPE, "RasterizeGradients has 10 items, not 0"),
    "no frame": (TYPE, "RasterizeGradients.frame must be a frame that `rasterize_views` returned"),
    "number for a frame": (TYPE, "RasterizeGradients.frame has the wrong type or shape"),
    "one frame twice": ("accepted", "one after the other"),
    "other coefficients": (VALUE, "not the Gaussians of the forward pass"),
    "another model's ride": (VALUE, "another model"),
    "face beyond the vertices": (INDEX, "a vertex that does not exist"),
    "largest face": (INDEX, "a vertex that does not exist"),
    "negative face": (INDEX, "a vertex that does not exist"),
    "faces changed later": ("accepted", "its own copy"),
    "edge without a first triangle": (INDEX, "a triangle that does not exist"),
    "edge with the largest triangle": (INDEX, "a triangle that does not exist"),
    "edge with a triangle below none": (INDEX, "a triangle that does not exist"),
    "largest high_pass": ("accepted", "the same"),
    "negative high_pass": (VALUE, "high_pass"),
    "box beyond the largest integer": (VALUE, "inside the picture"),
    "box at the largest integer": (VALUE, "inside the picture"),
    "parent of no joint": (VALUE, "after its parent"),
    "topology of too many vertices": (VALUE, "1099511627776 vertices; at most 16777216"),
    "topology of fewer vertices": (INDEX, "a vertex that does not exist"),
    "negative fragment": (INDEX, "a triangle that does not exist"),
    "picture of no rows": (VALUE, "must have pixels"),
    "picture too wide": (VALUE, "1048545 columns of pixels; at most 1048544"),
    "too many pixels": (VALUE, "2147549184 pixels; at most 2147483647"),
    "lengths beyond 32 bits": (VALUE, "4294967297 rows of pixels"),
    "products beyond 64 bits": (VALUE, "8796093022208 numbers per vertex; at most 2147483647"),
    "unaligned": (TYPE, "sigmoid()"),
    "copies are not written": (TYPE, "pose_face()"),
    "strided": (TYPE, "FaceArrays.rest has the wrong type or shape"),
    "adam by addresses": (TYPE, "AdamTask.values has the wrong type or shape"),
    "adam of other sizes": (VALUE, "the shape of the values"),
    "adam of many steps": (TYPE, "AdamTask.steps has the wrong type or shape"),
    "too many pairs": (VALUE, "2293690000, at most 2000000000; take fewer or smaller Gaussians, or a smaller picture"),
    "too many threads": (VALUE, "is 100000; give a number from 1 to 1024"),
    "negative threads": (VALUE, "is -3"),
    "memory that is not there": ("accepted", "failures"),
    "memory for several views": (MEMORY, ""),
    "functions without a valid call": ("accepted", "none"),
    "threads that cannot be had": ("accepted", "fewer"),
}


@pytest.fixture(scope="module")
def results() -> dict[str, tuple[str, str]]:
    """Run the cases and return the outcome of each, up to one that ends the process."""
    script = Path(__file__).with_name("native_cases.py")
    environment = {**os.environ, "MIEN_THREADS": "2"}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment, timeout=300)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return {name: (result, message) for name, result, message in lines} | {"stderr": ("", done.stderr[-500:])}


@pytest.mark.parametrize("name", EXPECTED)
def test_native_calls_are_refused(name: str, results: dict[str, tuple[str, str]]) -> None:
    assert name in results, f"the process ended: {results['stderr'][1]}"
    result, message = results[name]
    expected, part = EXPECTED[name]
    assert result == expected, message
    assert part in message


def test_every_case_is_expected(results: dict[str, tuple[str, str]]) -> None:
    assert set(results) - {"stderr"} == set(EXPECTED)


def test_tensors_that_no_memory_holds() -> None:
    for shape in ([2**62, 8], [2**63, 0], [2**40]):
        with pytest.raises(MemoryError):
            _native.recycled(shape)
    assert _native.recycled([0, 3]).shape == (0, 3)


@pytest.mark.parametrize("value", ["100000", "-2", "many", "2.5", "9" * 30])
def test_odd_numbers_of_threads_in_the_environment_are_told(value: str) -> None:
    code = "from mien import _native\ntry: _native.thread_count()\nexcept ValueError as error: print(error)"
    environment = {**os.environ, "MIEN_THREADS": value}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout.startswith("MIEN_THREADS is ")
    assert value in done.stdout
    assert "give a number from 1 to 1024, or 0" in done.stdout
