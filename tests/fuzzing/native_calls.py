"""Call every native function with mutated arguments, under AddressSanitizer and UndefinedBehaviorSanitizer.

    make fuzz-native CALLS=50000 SEED=1

Each call is a valid one (`native_baselines.py`) with one to three arguments changed: shapes, types, strides, alignment,
indices, integers at the edges, NaN, objects of other calls. An error in Python is fine, as long as it is one of
`REFUSALS`. A report of a sanitizer, a signal or 20 seconds of silence is a finding, and is printed with the command
that runs that call alone. Every call has its own random numbers, which depend on the seed and the call's number.
"""

import argparse
import collections
import importlib.util
import os
import signal
import subprocess
import sys
import sysconfig
import tempfile
import types
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.native_baselines import MAKERS, Rng, arguments_of

REFUSALS = (TypeError, ValueError, IndexError, OverflowError, MemoryError, BufferError)
SECONDS_A_CALL = 20
MOST_FINDINGS = 20
SETTINGS_FOR = 50
"""Number of consecutive calls with the same number of threads and the same instruction set."""
INTEGERS = [0, 1, -1, 2, 3, 15, 255, 2**15, 2**16, 2**24, 2**31 - 1, 2**31 - 2, 2**31, -(2**31), 2**32, 2**62]
INTEGERS += [2**63 - 1, -(2**63), 2**63, 2**64, 10**30]
FLOATS = [0.0, -0.0, 1.0, -1.0, 1e-45, 1e-30, 1e30, 3.4e38, 1e300, float("inf"), float("-inf"), float("nan")]
DTYPES = ["f4", "f8", "f2", "i4", "i8", "u1", "u4", "?", "c8", ">f4", "O", "U3"]
LENGTHS = [0, 1, 2, 3, 4, 7, 64]
STRANGERS = ["ride_backward", "rasterize_views_backward", "align_mesh", "pose_face"]
"""Functions whose arguments are passed to others. Together they take every class."""


def load(path: str) -> Any:
    """Load the native module from a file, without the package around it. Stand-ins replace its imports from torch."""
    dlpack = types.ModuleType("torch.utils.dlpack")
    dlpack.__dict__["from_dlpack"] = lambda exported: exported
    sys.modules |= {"torch": types.ModuleType("torch"), "torch.utils": types.ModuleType("torch.utils")}
    sys.modules["torch.utils.dlpack"] = dlpack
    spec = importlib.util.spec_from_file_location("_native", path)
    assert spec is not None
    assert spec.loader is not None
    native = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(native)
    return native


def bound_names(native: Any) -> set[str]:
    """Return the names of everything that can be called, except for classes that only functions make, and groups."""
    made = {"FaceModelData", "RigTopology", "Ride", "RasterizeFrame"}
    named = {name: getattr(native, name) for name in dir(native) if not name.startswith("_")}
    return {name for name, one in named.items() if callable(one) and not hasattr(one, "_fields")} - made


# Arguments are lists and tuples with their content; a place in them is a path of indices.


def places(value: Any, path: tuple[int, ...] = ()) -> list[tuple[int, ...]]:
    found = [path] if path else []
    if isinstance(value, list | tuple):
        for index, one in enumerate(value):
            found += places(one, (*path, index))
    return found


def at(value: Any, path: tuple[int, ...]) -> Any:
    for index in path:
        value = value[index]
    return value


def like(value: Any, items: list[Any]) -> Any:
    """Return the items as a list, a tuple, or the same named tuple if the number of items is the same."""
    if hasattr(value, "_fields"):
        return type(value)(*items) if len(items) == len(value) else tuple(items)
    return type(value)(items)


def put(value: Any, path: tuple[int, ...], new: Any) -> Any:
    if not path:
        return new
    items = list(value)
    items[path[0]] = put(items[path[0]], path[1:], new)
    return like(value, items)


def other_shape(rng: Rng, array: np.ndarray) -> np.ndarray:
    """Return the same numbers, repeated or cut, in another shape, or no numbers in a huge one."""
    shape, kind = list(array.shape), rng.integers(0, 6)
    axis = int(rng.integers(0, max(len(shape), 1)))
    if kind == 0 or not shape:
        shape.insert(axis, int(rng.choice(LENGTHS)))
    elif kind == 1:
        del shape[axis]
    elif kind == 2:
        shape[axis] = max(shape[axis] + int(rng.choice([-1, 1])), 0)
    elif kind == 3:
        shape[axis] = int(rng.choice(LENGTHS))
    elif kind == 4:
        shape.reverse()
    else:
        shape[axis] = 0
        shape[int(rng.integers(0, len(shape)))] = int(rng.choice([0, 2**20, 2**31, 2**32 + 4, 2**40, 2**61]))
        if 0 not in shape:
            shape.append(0)
    if 0 in shape:
        return np.empty(shape, array.dtype)
    return np.resize(array, shape) if array.size else np.zeros(LENGTHS[-1], array.dtype)


def other_layout(rng: Rng, array: np.ndarray) -> Any:
    """Return the same values elsewhere in memory: strided, broadcast, read-only, unaligned, or as a capsule."""
    kind = rng.integers(0, 8)
    if kind == 0 and array.ndim:
        return np.repeat(array, 2, axis=-1)[..., ::2]
    if kind == 1 and array.ndim:
        return array[::-1]
    if kind == 2:
        return np.asfortranarray(array)
    if kind == 3:
        return np.broadcast_to(array.ravel()[:1].reshape([1] * array.ndim) if array.size else array, array.shape)
    if kind == 4:
        array = array.copy()
        array.setflags(write=False)
        return array
    if kind == 5:
        memory = np.zeros(array.nbytes + 1, np.uint8)
        return memory[1:].view(array.dtype).reshape(array.shape) if array.nbytes else array
    if kind == 6 and array.dtype.kind in "fiu":
        return array.__dlpack__()
    return array.tolist()


def other_values(rng: Rng, array: np.ndarray) -> np.ndarray:
    """Return a copy with some numbers from the edges."""
    array = array.copy()
    if array.size == 0 or array.dtype.kind not in "fiu":
        return array
    share = float(rng.choice([0.0, 0.1, 1.0]))
    chosen = rng.random(array.shape) < share
    chosen.reshape(-1)[int(rng.integers(0, array.size))] = True
    with np.errstate(all="ignore"):
        if array.dtype.kind == "f":
            value = np.float64(rng.choice(FLOATS))
        elif rng.random() < 0.5:
            value = np.array(array.max(), np.int64) + rng.integers(-1, 3)
        else:
            value = np.int64(rng.choice([-1, -2, 2**31 - 1, -(2**31), 2**62, 2**63 - 1, -(2**63), 2**24]))
        array[chosen] = value.astype(array.dtype)
    return array


def changed_array(rng: Rng, array: np.ndarray) -> Any:
    kind = rng.random()
    try:
        if kind < 0.3:
            return other_shape(rng, array)
        if kind < 0.45:
            return other_layout(rng, array)
        if kind < 0.55:
            name = str(rng.choice(DTYPES))
            same_size = array.itemsize == np.dtype(name).itemsize != 8
            return array.view(name) if same_size else np.zeros(array.shape, name)
        return other_values(rng, array)
    except (MemoryError, BufferError, TypeError, ValueError):  # numpy refuses this itself
        return array


def changed(rng: Rng, value: Any) -> Any:
    """Return another value of about the same kind."""
    if isinstance(value, np.ndarray):
        return changed_array(rng, value)
    if isinstance(value, list | tuple) and value:
        items, index = list(value), int(rng.integers(0, len(value)))
        kind = rng.integers(0, 4)
        if kind == 0:
            del items[index]
        elif kind == 1:
            items.append(items[index])
        elif kind == 2:
            items = items[:index]
        else:
            items[index] = items[int(rng.integers(0, len(items)))]
        return like(value, items)
    if isinstance(value, str):
        return str(rng.choice(["", "avx2", "sse4", "x" * 1000, "a\0b", "\u00fc"]))
    if isinstance(value, int | float):
        return rng.choice(np.array(INTEGERS + FLOATS, object))
    return None


def is_whole(value: Any) -> bool:
    return isinstance(value, int) or (isinstance(value, np.ndarray) and value.dtype.kind in "iu")


def mutate(native: Any, rng: Rng, arguments: list[Any]) -> list[Any]:
    """Change one to three arguments. Some get a value from elsewhere in this call or from another call."""
    for _ in range(int(rng.integers(1, 4))):
        paths = places(arguments)
        if not paths or rng.random() < 0.03:
            arguments = changed(rng, arguments) if arguments else [None]
            continue
        if rng.random() < 0.4:  # prefer indices and counts
            paths = [path for path in paths if is_whole(at(arguments, path))] or paths
        path, kind = paths[int(rng.integers(0, len(paths)))], rng.random()
        if kind < 0.75:
            new = changed(rng, at(arguments, path))
        elif kind < 0.83:
            new = at(arguments, paths[int(rng.integers(0, len(paths)))])
        elif kind < 0.95:  # the same type, but from another call
            value: Any = at(arguments, path)
            stranger = arguments_of(str(rng.choice(STRANGERS)), native, rng)
            alike = [own for own in places(stranger) if isinstance(at(stranger, own), type(value))]
            new = at(stranger, alike[int(rng.integers(0, len(alike)))]) if alike else None
            if not alike or rng.random() < 0.1:
                own = type(value).__module__ == "_native" and not isinstance(value, tuple)
                kind_of: Any = type(value)
                new = kind_of.__new__(kind_of) if own else None
        else:
            new = rng.choice(np.array([None, object(), "x", b"x", 1, 0.5, {}, np.float32(1)], object))
        arguments = put(arguments, path, new)
    return arguments


def run_call(native: Any, seed: int, number: int) -> tuple[str, str]:
    """Make one call, and return the function's name and the outcome."""
    names = sorted(MAKERS)
    name, rng = names[number % len(names)], np.random.default_rng((seed, number))
    arguments = arguments_of(name, native, rng)
    valid = rng.random() < 0.05
    if not valid:
        arguments = mutate(native, rng, arguments)
    try:
        getattr(native, name)(*arguments)
    except REFUSALS as error:
        if valid:
            raise
        return name, type(error).__name__
    return name, "accepted"


def child(path: str, seed: int, first: int, last: int, log: Path) -> None:
    """Run the calls from `first` to `last` - 1. If a call ends the process, the last line of the log is incomplete."""
    warnings.simplefilter("ignore")  # numpy warns of objects that were never made
    native = load(path)
    assert bound_names(native) == set(MAKERS), bound_names(native) ^ set(MAKERS)
    assert native.TRIANGLE_FRAME_FLOATS == 20
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    for number in range(first, last):
        if number == first or number % SETTINGS_FOR == 0:
            turn = number // SETTINGS_FOR
            native.set_thread_count(1 + turn % 3)
            native.set_rasterize_isa(("avx512", "avx2", "sse4")[turn // 3 % 3])
        os.write(file, f"{number} ".encode())
        signal.alarm(SECONDS_A_CALL)
        name, result = run_call(native, seed, number)
        os.write(file, f"{name} {result}\n".encode())


def environment() -> dict[str, str]:
    """Return an environment in which the sanitizer is loaded first and finds what throws exceptions."""

    def found(library: str) -> str:
        command = [os.environ.get("CXX", "g++"), f"-print-file-name={library}"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    libraries = " ".join(found(library) for library in ("libasan.so", "libstdc++.so"))
    asan = "detect_leaks=0:allocator_may_return_null=1:max_allocation_size_mb=1500:hard_rss_limit_mb=3000"
    ubsan = "print_stacktrace=1:halt_on_error=1"
    own = {"LD_PRELOAD": libraries, "ASAN_OPTIONS": asan, "UBSAN_OPTIONS": ubsan, "PYTHONMALLOC": "malloc"}
    return {**os.environ, **own}


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("build", type=Path, help="folder that `make fuzz-native` built the sanitized core in")
    parser.add_argument("--calls", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--call", type=int, help="this call alone")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    library = str(options.build / f"_native{sysconfig.get_config_var('EXT_SUFFIX')}")
    if options.child:
        first, last, log = options.child
        child(library, options.seed, int(first), int(last), Path(log))
        return 0
    here = [sys.executable, "-m", "fuzzing.native_calls", str(options.build), "--seed", str(options.seed)]
    next_call, end = (0, options.calls) if options.call is None else (options.call, options.call + 1)
    findings, results = 0, collections.Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        while next_call < end and findings < MOST_FINDINGS:
            done = subprocess.run([*here, "--child", str(next_call), str(end), str(log)], env=environment())
            lines = log.read_text().splitlines()
            if done.returncode == 0:
                break
            findings += 1
            next_call = int(lines.pop().split()[0]) + 1 if lines else end
            log.write_text("".join(f"{line}\n" for line in lines))
            print(f"FINDING (exit {done.returncode}); again: {' '.join(here)} --call {next_call - 1}", flush=True)
        for line in log.read_text().splitlines():
            _, name, result = line.split()
            results[name, result] += 1
    report(results)
    print(f"{sum(results.values())} native calls with seed {options.seed}: {findings} findings")
    return int(findings > 0)


def report(results: collections.Counter[tuple[str, str]]) -> None:
    """Print the number of calls of each function, and of those that it accepted."""
    for name in sorted({name for name, _ in results}):
        own = {result: count for (of, result), count in results.items() if of == name}
        print(f"{name:28} {sum(own.values()):6} calls  {own.get('accepted', 0):6} accepted")


if __name__ == "__main__":
    sys.exit(main())
