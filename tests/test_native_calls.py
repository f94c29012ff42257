"""Native functions refuse arguments that do not belong together, and survive a lack of memory.
The cases run in another process, since a faulty core may end it. It prints a line of JSON for each case."""

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuzzing.native_baselines import MAKERS, arguments_of
from fuzzing.native_calls import bound_names
from mien import _native

TYPE, VALUE, INDEX, MEMORY = "TypeError", "ValueError", "IndexError", "MemoryError"
F32, I32, I64 = np.float32, np.int32, np.int64
MOST = 2**31 - 1
WIDEST = 32767 * 32


def arguments(name: str, seed: int = 0) -> list[Any]:
    return arguments_of(name, _native, np.random.default_rng(seed))


def call(name: str, place: int = -1, value: Any = None, **fields: Any) -> Any:
    """Make a valid call with the argument at a place replaced, or some fields of the group that is there."""
    given = arguments(name)
    if place >= 0:
        given[place] = given[place]._replace(**fields) if fields else value
    return getattr(_native, name)(*given)


def wide_splats(count: int, width: int = WIDEST, height: int = 1) -> _native.RasterizeView:
    """Gaussians as wide as the picture: each touches all of its tiles."""
    means = np.zeros((count, 3), F32)
    means[:, 2] = np.linspace(1, 2, count)
    quats = np.tile(np.array([1, 0, 0, 0], F32), (count, 1))
    scales, opacities = np.full((count, 3), 3, F32), np.full(count, 0.5, F32)
    gaussians = _native.GaussianArrays(means, quats, scales, opacities, np.zeros((count, 1, 3), F32))
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], F32)
    pictures = [np.zeros((height, width, 3), F32), np.zeros((height, width), F32), np.zeros(count, I32)]
    return _native.RasterizeView(gaussians, np.ones(3, F32), np.eye(4, dtype=F32), K, *pictures)


def draw(view: Any) -> None:
    _native.rasterize_views([view], False)


def picture_of_small_scene() -> bytes:
    view = arguments("rasterize_views", seed=7)[0][0]
    draw(view)
    return view.image.tobytes() + view.alpha.tobytes()


def with_room(megabytes: float, body: Callable[[], Any]) -> Any:
    """Call `body` with at most this much more address space."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + int(megabytes * 2**20), before[1]))
    try:
        return body()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def memory_that_is_not_there() -> str:
    """Run out of memory at different places of a forward pass, on every thread. Later calls give the same bytes."""
    _native.set_thread_count(3)
    scene, expected, failed = wide_splats(3000), picture_of_small_scene(), 0
    for megabytes in (0, 1, 4, 9, 20, 50, 90, 200, 300, 500):
        try:
            with_room(megabytes, lambda: _native.rasterize_views([scene], True))
        except MemoryError:
            failed += 1
        assert picture_of_small_scene() == expected
    return f"{failed} failures"


def memory_for_several_views() -> None:
    """Run out of memory in views that threads draw side by side. An exception in a thread would end the process."""
    _native.set_thread_count(3)
    views = [wide_splats(2000, width=WIDEST // 2) for _ in range(3)]
    with_room(30, lambda: _native.rasterize_views(views, False))


def threads_that_cannot_be_had() -> str:
    def many() -> str:
        _native.set_thread_count(600)
        return "fewer" if 1 <= _native.thread_count() < 600 else "all"

    expected = picture_of_small_scene()
    result = with_room(100, many)
    assert picture_of_small_scene() == expected
    _native.set_thread_count(2)
    assert picture_of_small_scene() == expected
    return result


def a_ride_of_another_model() -> None:
    mine, others = arguments("ride_backward", 1), arguments("ride_backward", 5)
    assert len(mine[3].rest) != len(others[3].rest)
    _native.ride_backward(others[0], *mine[1:])


def other_coefficients() -> None:
    """A backward pass with more of them than the forward pass had."""
    (task, *_) = arguments("rasterize_views_backward", 3)[0]
    more = np.zeros((len(task.gaussians.means), 16, 3), F32)
    assert task.gaussians.sh.shape != more.shape
    gaussians, gradients = task.gaussians._replace(sh=more), task.grad_gaussians._replace(sh=more.copy())
    _native.rasterize_views_backward([task._replace(gaussians=gaussians, grad_gaussians=gradients)])


def align_with(vertex: int, later: int | None = None) -> str:
    """Align a mesh whose faces all have one vertex, or get one after they were checked."""
    faces, *rest = arguments("AlignSurface")
    faces[:] = faces if later is not None else vertex
    surface = _native.AlignSurface(faces, *rest)
    faces[:] = faces if later is None else later
    seen = arguments("align_mesh", 3)[1]
    vertices = np.random.default_rng(0).standard_normal((42, 3)).astype(F32)
    _native.align_mesh(surface, seen._replace(vertices=vertices, normals=vertices), 1, None, None, None)
    return "its own copy"


def high_pass_of(radius: int) -> bytes:
    given = arguments("align_mesh", 3)
    given[2], given[4], given[5] = radius, *(np.zeros_like(given[1].image) for _ in range(2))
    _native.align_mesh(*given)
    return given[4].tobytes() + given[5].tobytes()


def large_picture() -> None:
    """Pass a picture of more than 2^31 pixels, in a sparse file that takes no memory."""
    with tempfile.TemporaryFile() as file:
        file.truncate(4 * 65536 * 32769)
        _native.box_of_nonzero(np.memmap(file, F32, "r+", shape=(32769, 65536)))


def products_beyond_64_bits() -> None:
    fragments = np.full((2**17, 2**4), -1, I32), np.zeros((2**17, 2**4, 3), F32)
    faces = np.zeros((0, 3), I64)
    _native.interpolate_mesh(*fragments, np.zeros((0, 2**43), F32), faces, np.zeros((0, 1, 1), F32))


def edges_with(first: int, second: int) -> None:
    given = arguments("mesh_loss")
    given[3].faces[0] = first, second
    _native.mesh_loss(*given)


def one_frame_twice() -> str:
    (task,) = arguments("rasterize_views_backward", 3)[0][:1]
    gradients = _native.GaussianArrays(*(np.zeros_like(array) for array in task.grad_gaussians))
    again = type(task)(*task[:6], gradients, *(np.zeros_like(array) for array in task[7:]))
    _native.set_thread_count(3)
    for _ in range(20):
        _native.rasterize_views_backward([task, again])
        pairs = zip((*task[6], *task[7:]), (*again[6], *again[7:]), strict=True)
        assert all(np.array_equal(one, other) for one, other in pairs)
    return "one after the other"


def backward_with(**changes: Any) -> None:
    """Run a valid backward pass with some fields of its first view replaced."""
    task, *_ = arguments("rasterize_views_backward")[0]
    _native.rasterize_views_backward([task._replace(**changes)])


def adam(place: int, value: Any) -> None:
    ((task, *_),) = arguments("adam_update")
    _native.adam_update([(*task[:place], value, *task[place + 1 :])])


def functions_without_a_valid_call() -> str:
    """Names that only the core or only the fuzzer's valid calls have, or whose call is not valid."""
    wrong = bound_names(_native) ^ set(MAKERS)
    for name in set(MAKERS) - wrong - {"set_thread_count", "set_rasterize_isa"}:  # which last beyond the call
        try:
            call(name)
        except TypeError:
            wrong.add(name)
    return ", ".join(sorted(wrong)) or "none"


CASES: dict[str, tuple[Callable[[], Any], str, str]] = {
    "short view": (lambda: draw(wide_splats(1, 64)[:-1]), TYPE, "RasterizeView has 7 items, not 6"),
    "group of other types": (
        lambda: call("pose_face", 1, joint_rest=np.zeros((3, 3), np.float64)),
        TYPE, "FaceArrays.joint_rest has the wrong type or shape"),
    "group without an array": (
        lambda: call("ride", 4, log_scales=None), TYPE, "LocalGaussians.log_scales has the wrong type or shape"),
    "no frame": (
        lambda: backward_with(frame=None),
        TYPE, "RasterizeGradients.frame must be a frame that `rasterize_views` returned"),
    "one frame twice": (one_frame_twice, "accepted", "one after the other"),
    "other coefficients": (other_coefficients, VALUE, "not the Gaussians of the forward pass"),
    "another model's ride": (a_ride_of_another_model, VALUE, "another model"),
    "face beyond the vertices": (lambda: align_with(10**6), INDEX, "a vertex that does not exist"),
    "negative face": (lambda: align_with(-(2**63)), INDEX, "a vertex that does not exist"),
    "faces changed later": (lambda: align_with(0, later=2**40), "accepted", "its own copy"),
    "edge without a first triangle": (lambda: edges_with(-1, 0), INDEX, "a triangle that does not exist"),
    "edge with the largest triangle": (lambda: edges_with(0, MOST), INDEX, "a triangle that does not exist"),
    "edge with a triangle below none": (lambda: edges_with(0, -2), INDEX, "a triangle that does not exist"),
    "largest high_pass": (
        lambda: high_pass_of(MOST) == high_pass_of(1000) == high_pass_of(MOST - 1), "accepted", "True"),
    "negative high_pass": (lambda: call("align_mesh", 2, -1), VALUE, "high_pass"),
    "box beyond the largest integer": (
        lambda: call("photometric_loss", 0, (1, 1, MOST, MOST)), VALUE, "inside the picture"),
    "parent of no joint": (
        lambda: call("make_face_model", 5, [-5] * len(arguments("make_face_model")[5])), VALUE, "after its parent"),
    "topology of too many vertices": (
        lambda: call("make_rig_topology", 0, 2**40), VALUE, "1099511627776 vertices; at most 16777216"),
    "topology of fewer vertices": (lambda: call("make_rig_topology", 0, 1), INDEX, "a vertex that does not exist"),
    "negative fragment": (
        lambda: call("interpolate_mesh", 0, np.full_like(arguments("interpolate_mesh")[0], -2)),
        INDEX, "a triangle that does not exist"),
    "picture of no rows": (
        lambda: draw(wide_splats(4, 64)._replace(image=np.zeros((0, 64, 3), F32), alpha=np.zeros((0, 64), F32))),
        VALUE, "must have pixels"),
    "picture too wide": (lambda: draw(wide_splats(1, WIDEST + 1)), VALUE, "1048545 columns of pixels; at most 1048544"),
    "too many pixels": (large_picture, VALUE, "2147549184 pixels; at most 2147483647"),
    "lengths beyond 32 bits": (
        lambda: _native.box_of_nonzero(np.zeros((2**32 + 1, 0), F32)), VALUE, "4294967297 rows of pixels"),
    "products beyond 64 bits": (
        products_beyond_64_bits, VALUE, "8796093022208 numbers per vertex; at most 2147483647"),
    "unaligned": (
        lambda: _native.sigmoid(np.zeros(25, np.uint8)[1:].view(F32), np.zeros(6, F32)), TYPE, "sigmoid()"),
    "copies are not written": (
        lambda: call("pose_face", 3, arguments("pose_face")[3].astype(np.float64)), TYPE, "pose_face()"),
    "strided": (
        lambda: call("pose_face", 1, rest=np.repeat(arguments("pose_face")[1].rest, 2, 1)[:, ::2]),
        TYPE, "FaceArrays.rest has the wrong type or shape"),
    "adam by addresses": (lambda: adam(0, 4096), TYPE, "AdamTask.values has the wrong type or shape"),
    "adam of other sizes": (lambda: adam(1, np.zeros(1, F32)), VALUE, "the shape of the values"),
    "too many pairs": (
        lambda: draw(wide_splats(70_000)),
        VALUE, "2293690000, at most 2000000000; take fewer or smaller Gaussians, or a smaller picture"),
    "too many threads": (lambda: _native.set_thread_count(100_000), VALUE, "is 100000; give a number from 1 to 1024"),
    "memory that is not there": (memory_that_is_not_there, "accepted", "failures"),
    "memory for several views": (memory_for_several_views, MEMORY, ""),
    "tensors that no memory holds": (lambda: _native.recycled([2**62, 8]), MEMORY, ""),
    "empty tensors": (lambda: tuple(_native.recycled([0, 3]).shape), "accepted", "(0, 3)"),
    "functions without a valid call": (functions_without_a_valid_call, "accepted", "none"),
    "threads that cannot be had": (threads_that_cannot_be_had, "accepted", "fewer"),
}  # fmt: skip
"""Name of a case -> the call, its outcome (the name of an error), and a part of the message or result."""


def main() -> None:
    """Run the cases. Python calls this in a process of its own."""
    for name, (call_it, *_) in CASES.items():
        try:
            result, message = "accepted", str(call_it())
        except (TypeError, ValueError, IndexError, OverflowError, MemoryError) as error:
            result, message = type(error).__name__, str(error).splitlines()[0]
        print(json.dumps([name, result, message]), flush=True)


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in the folder of the tests."""
    command, own = [sys.executable, "-c", code], {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=own, timeout=300, cwd=Path(__file__).parent)


def test_native_calls_are_refused() -> None:
    done = python("import test_native_calls; test_native_calls.main()", MIEN_THREADS="2")
    results = {name: rest for name, *rest in map(json.loads, done.stdout.splitlines())}
    wrong = {
        name: results.get(name, f"the process ended: {done.stderr[-500:]}")
        for name, (_, expected, part) in CASES.items()
        if name not in results or results[name][0] != expected or part not in results[name][1]
    }
    assert wrong == {}


@pytest.mark.parametrize("value", ["100000", "-2", "many", "9" * 30])
def test_odd_numbers_of_threads_in_the_environment_are_told(value: str) -> None:
    tried = "from mien import _native\ntry: _native.thread_count()\nexcept ValueError as error: print(error)"
    told = python(tried, MIEN_THREADS=value).stdout
    assert told.startswith("MIEN_THREADS is ")
    assert value in told
    assert "give a number from 1 to 1024, or 0" in told
