"""Read numbers from a pickle without running any of its code: some face models exist only as pickles.

A pickle names functions, and reading it calls them. Here Python's own unpickler gets a stand-in for every name, which
only records its arguments. So the worst outcome of a hostile file is that it is refused. Memory is bounded as well:
reads are counted, texts are as long as their bytes in the file, and keys that are no text are never hashed. Numpy's
arrays, scipy's compressed matrices and the values of chumpy's variables are then converted to arrays (of the three,
only numpy has to be installed). Everything else is dropped.
"""

import io
import math
import pickle
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from mien.face.models.npz import MAX_MODEL_BYTES, readable

_MAX_FILE_BYTES = MAX_MODEL_BYTES + (16 << 20)
_MAX_READS = 100_000
"""Most reads of a pickle, at least one for each opcode. FLAME's files have some hundreds; each costs up to about a
hundred bytes of memory."""
_Unpickler: Any = pickle._Unpickler  # pyright: ignore[reportPrivateUsage]
"""Python's own, since that in C allocates by the numbers in the file."""
_NUMBERS = re.compile(r"[biuf][1248]")  # numpy's type codes for arrays of plain numbers


class _StandIn(dict[str, Any]):
    """Anything that a pickle names or builds. It records arguments, state, and entries by texts, and does nothing."""

    __slots__ = ("arguments", "name", "state")

    def __init__(self, name: str = "", arguments: tuple[Any, ...] = ()) -> None:
        self.name = name
        """Module and name in the pickle, joined by a dot."""
        self.arguments = arguments
        self.state: Any = None

    def __call__(self, *arguments: Any) -> "_StandIn":
        return _StandIn(self.name, arguments)

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None:
        if isinstance(key, str):
            super().__setitem__(key, value)

    def append(self, _: Any) -> None:
        """Drop an entry of what would be a list or a set."""

    extend = append


class _CountedBytes(io.BytesIO):
    """Bytes of which only so many pieces are read."""

    reads = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self.reads += 1
        if self.reads > _MAX_READS:
            raise ValueError(f"it has more than {_MAX_READS:,} parts")
        return super().read(size)


class _InertUnpickler(_Unpickler):
    """Python's unpickler, in which names, what they make, and dictionaries are stand-ins."""

    stack: list[Any]

    def find_class(self, module: str, name: str) -> _StandIn:
        return _StandIn(f"{module}.{name}")

    def _call(self) -> None:
        arguments, called = self.stack.pop(), self.stack.pop()
        arguments = arguments if isinstance(arguments, tuple) else ()
        if called.name.endswith("._reconstructor") and arguments:
            called = arguments[0]  # copyreg's function has the class as its first argument
        self.stack.append(called(*arguments))

    def _call_with_names(self) -> None:
        self.stack.pop()
        self._call()

    def _dictionary(self) -> None:
        values, made = self.pop_mark(), _StandIn()
        for key, value in zip(values[::2], values[1::2], strict=True):
            made[key] = value
        self.stack.append(made)

    dispatch = {
        **_Unpickler.dispatch,
        pickle.REDUCE[0]: _call,
        pickle.NEWOBJ[0]: _call,
        pickle.NEWOBJ_EX[0]: _call_with_names,
        pickle.DICT[0]: _dictionary,
        pickle.EMPTY_DICT[0]: lambda self: self.stack.append(_StandIn()),
        pickle.EMPTY_SET[0]: _Unpickler.load_empty_list,
        pickle.FROZENSET[0]: _Unpickler.load_list,
        pickle.ADDITEMS[0]: _Unpickler.load_appends,
        pickle.BYTEARRAY8[0]: _Unpickler.load_binbytes8,
        pickle.FRAME[0]: lambda self: self.read(8),  # what is in the frame is read from the file as well
    }


def read_inert_pickle(path: Path, wanted: Collection[str] | None = None) -> dict[str, Any]:
    """Return the named arrays, numbers and texts of a pickled dictionary: those that are wanted, or all."""
    with readable(path, "a pickle of named arrays", "download the face model's own file again"):
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise ValueError(f"more than {_MAX_FILE_BYTES:,} bytes are too many for a face model")
        return _arrays(_entries(path.read_bytes()), wanted)


def parse_inert_pickle(data: bytes) -> dict[str, Any]:
    """Return the arrays, numbers and texts of a pickled dictionary of dictionaries, by names such as "outer.inner"."""
    flat: dict[str, Any] = {}
    for key, value in _entries(data).items():
        inner = value.items() if isinstance(value, _StandIn) else ()
        flat |= {f"{key}.{name}": each for name, each in inner} or {key: value}
    return _arrays(flat, None)


def _entries(data: bytes) -> dict[str, Any]:
    content = _InertUnpickler(_CountedBytes(data), encoding="latin1").load()
    if not isinstance(content, _StandIn):
        raise TypeError(f"it holds a {type(content).__name__}, not named arrays")
    return content


def _arrays(named: dict[str, Any], wanted: Collection[str] | None) -> dict[str, Any]:
    found: dict[str, Any] = {}
    left = MAX_MODEL_BYTES
    for key, value in named.items():
        made = _plain(value) if wanted is None or key in wanted else None
        if made is None:
            continue
        left -= made.nbytes if isinstance(made, np.ndarray) else 0
        if left < 0:
            raise ValueError(f"its arrays have more than {MAX_MODEL_BYTES:,} bytes together")
        found[key] = made
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, (str, int, float)):
        return value
    if not isinstance(value, _StandIn):
        return None
    if value.name.endswith("._reconstruct"):
        return _array(value.state)
    if value.name.endswith("._frombuffer"):
        raw, kind, shape, order, *axes = value.arguments
        array = _array((1, shape, kind, order == "F", raw))
        return array.transpose(axes[0]) if array is not None and order == "K" and axes else array
    if not isinstance(value.state, dict):
        return None
    if {"data", "indices", "indptr"} <= value.state.keys():
        return _dense(value.state, by_column="csc" in value.name)
    # chumpy's variables hold their value as x.
    return _plain(value.state.get("x"))


def _raw(value: Any) -> bytes | None:
    """Return the bytes in a value: bytes, text that holds bytes as in Python 2, or a `_codecs.encode` call."""
    if isinstance(value, _StandIn) and value.name == "_codecs.encode" and value.arguments:
        value = value.arguments[0]
    if isinstance(value, str):
        return value.encode("latin1")
    return bytes(value) if isinstance(value, (bytes, bytearray)) else None


def _array(state: Any) -> np.ndarray | None:
    """Build an array from numpy's state of it: version, shape, type, column-major flag, bytes."""
    if not isinstance(state, tuple) or len(state) != 5:
        return None
    _, shape, kind, by_column, content = state
    code = kind.arguments[0] if isinstance(kind, _StandIn) and kind.arguments else None
    raw = _raw(content)
    if not isinstance(code, str) or not _NUMBERS.fullmatch(code) or raw is None:
        return None
    big = isinstance(kind.state, tuple) and ">" in kind.state
    values = np.frombuffer(raw, np.dtype(code).newbyteorder(">" if big else "<"))
    return values.reshape(shape, order="F" if by_column else "C").astype(code)


def _dense(state: dict[str, Any], by_column: bool) -> np.ndarray | None:
    """Build a dense array from scipy's state of a compressed matrix."""
    data, indices, starts = (_plain(state[name]) for name in ("data", "indices", "indptr"))
    shape = state.get("_shape", state.get("shape"))
    if data is None or indices is None or starts is None or shape is None:
        return None
    rows, columns = (int(size) for size in shape)
    if rows < 0 or columns < 0 or 8 * math.prod((rows, columns)) > MAX_MODEL_BYTES:
        raise ValueError(f"a matrix of {rows} x {columns} numbers is too large for a face model")
    lengths = np.diff(starts)
    lines = columns if by_column else rows
    if starts.shape != (lines + 1,) or (lengths < 0).any() or lengths.sum() != len(data) or (indices < 0).any():
        raise ValueError("the parts of a compressed matrix do not fit together")
    matrix = np.zeros((columns, rows) if by_column else (rows, columns))
    np.add.at(matrix, (np.repeat(np.arange(lines), lengths), indices), data)
    return matrix.T if by_column else matrix
