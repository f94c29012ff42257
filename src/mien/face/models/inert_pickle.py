"""Read numbers from a pickle without running any of its code: some face models exist only as pickles.

A pickle is a program for a stack machine: it names functions, and reading it calls them. This module follows the
program with a machine of its own, in which every name is a stand-in that only records its arguments. So the worst
outcome of a hostile file is that it is refused. Memory is bounded as well: opcodes are counted, and strings are as long
as their bytes in the file. Numpy's arrays, scipy's compressed matrices and the values of chumpy's variables are then
converted to arrays (of the three, only numpy has to be installed). Everything else is dropped.
"""

import codecs
import io
import math
import pickletools
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from mien.errors import UserError
from mien.face.models.npz import MAX_MODEL_BYTES

_MAX_FILE_BYTES = MAX_MODEL_BYTES + (16 << 20)
"""Largest file in bytes."""
_MAX_OPCODES = 400_000
"""Most opcodes of a pickle. FLAME's files have some hundreds; each costs up to about a hundred bytes of memory."""
_NUMBERS = re.compile(r"[biuf][1248]")
"""Numpy's type codes for arrays of plain numbers."""
_OPCODES = {ord(opcode.code): opcode for opcode in pickletools.opcodes}


class _StandIn:
    """Anything that a pickle names or builds. It records arguments, state and entries, and does nothing."""

    __slots__ = ("arguments", "entries", "name", "state")

    def __init__(self, name: str = "", arguments: Any = (), entries: dict[str, Any] | None = None) -> None:
        self.name = name
        """Module and name in the pickle, joined by a dot."""
        self.arguments: tuple[Any, ...] = arguments if isinstance(arguments, tuple) else ()
        self.state: Any = None
        self.entries = entries


def read_inert_pickle(path: Path, wanted: Collection[str] | None = None) -> dict[str, Any]:
    """Return the named arrays, numbers and texts of a pickled dictionary. Other entries are left out.

    Args:
        path: Path of the pickle.
        wanted: Names to read; all by default.
    """
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise UserError(f"{path}: has more than {_MAX_FILE_BYTES:,} bytes, too many for a face model")
        content = _Machine(path.read_bytes()).run()
        named = content.entries if isinstance(content, _StandIn) else content
        values = {} if not isinstance(named, dict) else _arrays(named, wanted)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give the face model's file") from None
    except UserError:
        raise
    except Exception as error:  # a damaged pickle may fail in any way
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: is not a pickle, or is damaged ({reason}); download it again") from None
    if not isinstance(named, dict):
        raise UserError(f"{path}: holds a {type(content).__name__}, not named arrays; give the face model's own file")
    return values


def parse_inert_pickle(data: bytes) -> dict[str, Any]:
    """Return the arrays, numbers and texts of a pickled dictionary of dictionaries, by names such as "outer.inner".

    Raises:
        ValueError: it is no pickle, damaged or too large, or holds no dictionary.
    """
    try:
        content = _Machine(data).run()
        named = content.entries if isinstance(content, _StandIn) else content
        if not isinstance(named, dict):
            raise ValueError(f"it holds a {type(content).__name__}, not named arrays")
        flat: dict[str, Any] = {}
        for key, value in named.items():
            inner = value.entries if isinstance(value, _StandIn) else value
            if isinstance(inner, dict):
                flat |= {f"{key}.{name}": each for name, each in inner.items()}
            else:
                flat[str(key)] = value
        return _arrays(flat, None)
    except Exception as error:  # a damaged pickle may fail in any way
        raise ValueError(" ".join(str(error).split())[:200]) from None


class _Machine:
    """Executes the opcodes of a pickle."""

    def __init__(self, data: bytes) -> None:
        self._file = io.BytesIO(data)
        self._stack: list[Any] = []
        self._outer: list[list[Any]] = []
        """Stacks below the marks."""
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        """Execute the pickle and return the object that it builds."""
        for _ in range(_MAX_OPCODES):
            code = self._file.read(1)
            if not code or code[0] not in _OPCODES:
                raise ValueError("its end is missing" if not code else f"unknown opcode {code!r}")
            opcode = _OPCODES[code[0]]
            if opcode.name == "STOP":
                return self._stack.pop()
            argument = None if opcode.arg is None else self._argument(opcode.name, opcode.arg)
            act = _ACTIONS.get(opcode.name)
            if act is None:
                raise ValueError(f"it uses {opcode.name}, which files of arrays do not need")
            act(self, argument)
        raise ValueError(f"it has more than {_MAX_OPCODES:,} opcodes")

    def _argument(self, name: str, described: pickletools.ArgumentDescriptor) -> Any:
        if name != "STRING":
            return described.reader(self._file)
        # Numpy reads the bytes of its arrays in Python 2 pickles as latin1. For this opcode pickletools accepts only
        # ASCII.
        quoted = self._file.readline().strip()
        if len(quoted) < 2 or quoted[:1] not in b"'\"" or quoted[-1:] != quoted[:1]:
            raise ValueError("it has a text without quotes")
        return codecs.escape_decode(quoted[1:-1])[0].decode("latin1")

    def push(self, value: Any) -> None:
        """Push a value."""
        self._stack.append(value)

    def pop(self) -> Any:
        """Remove and return the value on top."""
        return self._stack.pop()

    def top(self) -> Any:
        """Return the value on top, which stays."""
        return self._stack[-1]

    def mark(self) -> None:
        """Start a group of values."""
        self._outer.append(self._stack)
        self._stack = []

    def group(self) -> list[Any]:
        """Return the values since the last mark, and remove the mark."""
        values, self._stack = self._stack, self._outer.pop()
        return values

    def drop(self) -> None:
        """Drop the value on top, or a mark that nothing follows."""
        if self._stack:
            self._stack.pop()
        else:
            self.group()

    def keep(self, number: int | None) -> None:
        """Store the value on top in the memo."""
        self._memo[len(self._memo) if number is None else number] = self._stack[-1]

    def recall(self, number: int) -> None:
        """Push a value from the memo."""
        self._stack.append(self._memo[number])

    def call(self, arguments: Any) -> None:
        """Push a stand-in for the result of calling the name on top."""
        called = self.pop()
        name = called.name if isinstance(called, _StandIn) else ""
        if name.endswith("._reconstructor") and isinstance(arguments, tuple) and arguments:
            # copyreg's `_reconstructor` has the class as its first argument.
            name = arguments[0].name if isinstance(arguments[0], _StandIn) else ""
        self.push(_StandIn(name, arguments))

    def set_state(self) -> None:
        """Pop a state and give it to the value below."""
        state = self.pop()
        if isinstance(self.top(), _StandIn):
            self.top().state = state

    def set_entries(self, values: list[Any]) -> None:
        """Add alternating keys and values to the dictionary on top. Keys that are not text are dropped."""
        target = self.top()
        if isinstance(target, _StandIn):
            target.entries = target.entries if target.entries is not None else {}
            target = target.entries
        if isinstance(target, dict):
            target.update((key, value) for key, value in _pairs(values) if isinstance(key, str))

    def append(self, values: list[Any]) -> None:
        """Append values to the list on top."""
        if isinstance(self.top(), list):
            self.top().extend(values)


def _pairs(values: list[Any]) -> Any:
    return zip(values[::2], values[1::2], strict=True)


def _tuple_of(count: int) -> Callable[[_Machine, Any], None]:
    def act(machine: _Machine, _: Any) -> None:
        values = [machine.pop() for _ in range(count)]
        machine.push(tuple(reversed(values)))

    return act


def _drop_group(machine: _Machine, _: Any) -> None:
    machine.group()


def _instance(machine: _Machine, _: Any) -> None:
    kind, *arguments = machine.group()
    machine.push(kind)
    machine.call(tuple(arguments))


def _new_object_with_names(machine: _Machine, _: Any) -> None:
    machine.pop()
    machine.call(machine.pop())


def _dictionary(machine: _Machine, _: Any) -> None:
    machine.push({key: value for key, value in _pairs(machine.group()) if isinstance(key, str)})


def _set_entry(machine: _Machine, _: Any) -> None:
    value, key = machine.pop(), machine.pop()
    machine.set_entries([key, value])


_LITERALS = (
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "UNICODE", "BINUNICODE",
    "SHORT_BINUNICODE", "BINUNICODE8",
)  # fmt: skip
_ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(_LITERALS, lambda machine, value: machine.push(value)),
    **dict.fromkeys(("PROTO", "FRAME"), lambda machine, _: None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), lambda machine, number: machine.keep(number)),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda machine, number: machine.recall(number)),
    **dict.fromkeys(("REDUCE", "NEWOBJ"), lambda machine, _: machine.call(machine.pop())),
    "NONE": lambda machine, _: machine.push(None),
    "NEWTRUE": lambda machine, _: machine.push(True),
    "NEWFALSE": lambda machine, _: machine.push(False),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "EMPTY_SET": lambda machine, _: machine.push([]),
    "MARK": lambda machine, _: machine.mark(),
    "LIST": lambda machine, _: machine.push(machine.group()),
    "FROZENSET": lambda machine, _: machine.push(machine.group()),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.group())),
    "TUPLE1": _tuple_of(1),
    "TUPLE2": _tuple_of(2),
    "TUPLE3": _tuple_of(3),
    "DICT": _dictionary,
    "APPEND": lambda machine, _: machine.append([machine.pop()]),
    "APPENDS": lambda machine, _: machine.append(machine.group()),
    "ADDITEMS": lambda machine, _: machine.append(machine.group()),
    "SETITEM": _set_entry,
    "SETITEMS": lambda machine, _: machine.set_entries(machine.group()),
    "POP": lambda machine, _: machine.drop(),
    "POP_MARK": _drop_group,
    "DUP": lambda machine, _: machine.push(machine.top()),
    "GLOBAL": lambda machine, name: machine.push(_StandIn(".".join(name.split(" ", 1)))),
    "STACK_GLOBAL": lambda machine, _: machine.push(_StandIn(".".join(reversed([machine.pop(), machine.pop()])))),
    "BUILD": lambda machine, _: machine.set_state(),
    "OBJ": _instance,
    "INST": lambda machine, name: machine.push(_StandIn(".".join(name.split(" ", 1)), tuple(machine.group()))),
    "NEWOBJ_EX": _new_object_with_names,
}
"""The action of each opcode, by its name in `pickletools`."""


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
