"""Numbers out of a pickle without running anything that it names: some face models come as nothing else.

A pickle is a program: it names functions, and reading it calls them. Here every name leads to a stand-in that only
remembers what it was given, so the worst that a hostile file can do is to be refused. Of what the stand-ins hold,
numpy's arrays, scipy's compressed matrices and the values of chumpy's variables are turned into arrays (none of the
three has to be installed, numpy apart); everything else is dropped.
"""

import pickle
import re
from pathlib import Path
from typing import IO, Any

import numpy as np

from mien.errors import UserError

_NUMBERS = re.compile(r"[biuf][1248]")
"""Type codes of numpy for arrays of plain numbers."""


class _StandIn(dict):
    """Whatever a pickle builds: remembers the arguments and the state, does nothing."""

    name = ""
    """Module and name in the pickle."""
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __new__(cls, *arguments: Any, **_: Any) -> "_StandIn":
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __init__(self, *_: Any, **__: Any):
        super().__init__()

    def __call__(self, *_: Any, **__: Any) -> "_StandIn":
        return _StandIn()

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def append(self, value: Any) -> None:
        """A list's, of which nothing is wanted."""

    def extend(self, values: Any) -> None:
        """A list's, of which nothing is wanted."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("_codecs", "encode"):
            return _encoded
        if name == "_reconstructor":
            # copyreg's, with the class as its first argument.
            return lambda kind, *_: kind() if isinstance(kind, type) and issubclass(kind, _StandIn) else _StandIn()
        return type("_StandIn", (_StandIn,), {"name": f"{module}.{name}"})


def read_inert_pickle(path: Path) -> dict[str, Any]:
    """The named arrays (and numbers and texts) of a pickled dictionary; what is none of these is left out.

    Raises:
        UserError: the file is missing, is no pickle or a damaged one, or holds no dictionary.
    """
    try:
        with path.open("rb") as file:
            content = _load(file)
        values = {str(key): _plain(value) for key, value in content.items()} if isinstance(content, dict) else {}
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give the face model's file") from None
    except Exception as error:  # a damaged pickle may fail in any way
        raise UserError(f"{path}: is no pickle, or a damaged one ({error}); download it again") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds a {type(content).__name__}, not named arrays; give the face model's own file")
    return {key: value for key, value in values.items() if value is not None}


def _load(file: IO[bytes]) -> Any:
    # latin1 is how numpy's arrays in pickles of Python 2 are read: their bytes were text there.
    return _Unpickler(file, encoding="latin1").load()


def _encoded(text: str, *_: Any) -> bytes:
    return text.encode("latin1")


def _plain(value: Any) -> Any:
    if isinstance(value, (str, int, float)):
        return value
    if not isinstance(value, _StandIn):
        return None
    if value.name.endswith("._reconstruct"):
        return _array(value.state)
    if value.name.endswith("._frombuffer"):
        raw, kind, shape, order, *axes = value.arguments
        array = _array((1, shape, kind, order == "F", bytes(raw)))
        return array.transpose(axes[0]) if array is not None and order == "K" and axes else array
    if not isinstance(value.state, dict):
        return None
    if {"data", "indices", "indptr"} <= value.state.keys():
        return _dense(value.state, by_column="csc" in value.name)
    # chumpy's variables hold their value as x.
    return _plain(value.state.get("x"))


def _array(state: Any) -> np.ndarray | None:
    """Numpy's state of an array: version, shape, type, whether columns come first, bytes."""
    if not isinstance(state, tuple) or len(state) != 5:
        return None
    _, shape, kind, by_column, raw = state
    code = kind.arguments[0] if isinstance(kind, _StandIn) and kind.arguments else None
    raw = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(code, str) or not _NUMBERS.fullmatch(code) or not isinstance(raw, bytes):
        return None
    big = isinstance(kind.state, tuple) and ">" in kind.state
    values = np.frombuffer(raw, np.dtype(code).newbyteorder(">" if big else "<"))
    return values.reshape(shape, order="F" if by_column else "C").astype(code)


def _dense(state: dict[str, Any], by_column: bool) -> np.ndarray | None:
    """Scipy's state of a compressed matrix."""
    data, indices, starts = (_plain(state[name]) for name in ("data", "indices", "indptr"))
    shape = state.get("_shape", state.get("shape"))
    if data is None or indices is None or starts is None or shape is None:
        return None
    rows, columns = (int(size) for size in shape)
    matrix = np.zeros((columns, rows) if by_column else (rows, columns))
    line = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    np.add.at(matrix, (line, indices), data)
    return matrix.T if by_column else matrix
