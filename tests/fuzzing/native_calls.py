"""Call every native function with mutated arguments, under AddressSanitizer and UndefinedBehaviorSanitizer.

    make fuzz-native CALLS=50000 SEED=1

Each call is a valid one (`native_baselines.py`) with one to three arguments changed: shapes, types, strides, alignment,
indices, integers at the edges, NaN, objects of other calls. An error in Python is fine, as long as it is one of
`REFUSALS`. A report of a sanitizer, a signal or 20 seconds of silence is a finding, and is printed with the command
that runs that call alone. Every call has its own random numbers, which depend on the seed and the call's number."""

import argparse
import collections
import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import sysconfig
import tempfile
import types
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing import kinds
from fuzzing.kinds import edge_number
from fuzzing.native_baselines import MAKERS, arguments_of

REFUSALS = (TypeError, ValueError, IndexError, OverflowError, MemoryError, BufferError)
SECONDS_A_CALL = 20
MOST_FINDINGS = 20
SETTINGS_FOR = 50
"""Number of consecutive calls with the same number of threads and the same instruction set."""
STRANGERS = ("ride_backward", "rasterize_views_backward", "align_mesh", "pose_face", "activation_table")
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
    made = {"FaceActivations", "FaceModelData", "RigTopology", "Ride", "RasterizeFrame"}
    named = {name: getattr(native, name) for name in dir(native) if not name.startswith("_")}
    return {name for name, one in named.items() if callable(one) and not hasattr(one, "_fields")} - made


# Arguments are lists and tuples with their content; a place in them is a path of indices.


def places(value: Any, path: tuple[int, ...] = ()) -> list[tuple[int, ...]]:
    inner = enumerate(value) if isinstance(value, list | tuple) else ()
    return [path] * bool(path) + [place for index, one in inner for place in places(one, (*path, index))]


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
    return like(value, [put(one, path[1:], new) if index == path[0] else one for index, one in enumerate(value)])


def read_only(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.setflags(write=False)
    return array


LAYOUTS: tuple[Callable[[np.ndarray], Any], ...] = (
    lambda array: np.repeat(array, 2, axis=-1)[..., ::2],
    lambda array: array[::-1],
    np.asfortranarray,
    lambda array: np.broadcast_to(array.ravel()[0], array.shape),
    read_only,
    lambda array: np.frombuffer(bytearray(b"x" + array.tobytes()), np.uint8)[1:].view(array.dtype).reshape(array.shape),
    lambda array: array.__dlpack__(),
    lambda array: array.tolist(),
    lambda array: array.astype(">f4"),
    lambda array: array.astype(object),
)
"""The same values elsewhere in memory: strided, broadcast, read-only, unaligned, as capsule, list or objects."""


def changed(dice: Random, value: Any) -> Any:
    """Return another value of about the same kind."""
    if isinstance(value, np.ndarray):
        with contextlib.suppress(MemoryError, BufferError, TypeError, ValueError, IndexError):  # by numpy itself
            return dice.choice(LAYOUTS)(value) if dice.random() < 0.15 else kinds.faulty_array(value, dice)[1]
        return value
    if isinstance(value, list | tuple) and value:
        return like(value, kinds.faulty_list(value, dice))
    if isinstance(value, str):
        return dice.choice(("", "avx2", "sse4", "x" * 1000, "a\0b", "\u00fc"))
    return edge_number(dice) if isinstance(value, int | float) else None


def is_whole(value: Any) -> bool:
    return isinstance(value, int) or (isinstance(value, np.ndarray) and value.dtype.kind in "iu")


def of_a_stranger(native: Any, dice: Random, value: Any) -> Any:
    """Return a value of the same type from the call of another function, or an object of it that was never made."""
    stranger = arguments_of(dice.choice(STRANGERS), native, np.random.default_rng(dice.getrandbits(32)))
    alike = [at(stranger, own) for own in places(stranger) if isinstance(at(stranger, own), type(value))]
    if alike and dice.random() >= 0.1:
        return dice.choice(alike)
    own: Any = type(value) if type(value).__module__ == "_native" and not isinstance(value, tuple) else None
    return own and own.__new__(own)


def mutate(native: Any, dice: Random, arguments: list[Any]) -> list[Any]:
    """Change one to three arguments. Some get a value from elsewhere in this call or from another call."""
    for _ in range(dice.randint(1, 3)):
        paths = places(arguments)
        if not paths or dice.random() < 0.03:
            arguments = changed(dice, arguments) if arguments else [None]
            continue
        if dice.random() < 0.4:  # prefer indices and counts
            paths = [path for path in paths if is_whole(at(arguments, path))] or paths
        path, kind = dice.choice(paths), dice.random()
        if kind < 0.75:
            new = changed(dice, at(arguments, path))
        elif kind < 0.83:
            new = at(arguments, dice.choice(paths))
        elif kind < 0.95:
            new = of_a_stranger(native, dice, at(arguments, path))
        else:
            new = dice.choice((None, object(), "x", b"x", 1, 0.5, {}, np.float32(1)))
        arguments = put(arguments, path, new)
    return arguments


def run_call(native: Any, seed: int, number: int) -> tuple[str, str]:
    """Make one call, and return the function's name and the outcome."""
    names = sorted(MAKERS)
    name, dice = names[number % len(names)], Random(f"{seed} {number}")
    arguments = arguments_of(name, native, np.random.default_rng((seed, number)))
    valid = dice.random() < 0.05
    if not valid:
        arguments = mutate(native, dice, arguments)
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
    findings, results = 0, collections.Counter[tuple[str, ...]]()
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
            results[tuple(line.split()[1:])] += 1
    for name in sorted({name for name, _ in results}):
        own = {result: count for (of, result), count in results.items() if of == name}
        print(f"{name:28} {sum(own.values()):6} calls  {own.get('accepted', 0):6} accepted")
    print(f"{sum(results.values())} native calls with seed {options.seed}: {findings} findings")
    return int(findings > 0)


if __name__ == "__main__":
    sys.exit(main())
