"""Make faults in safetensors files: in the header, in offsets, types and shapes, and in the numbers."""

import json
from random import Random
from typing import Any

import numpy as np
import safetensors.numpy

from fuzzing.edges import FLOATS, INTEGERS, edge_integer, edge_value
from fuzzing.json_faults import faulty_json, written

_DTYPES = (
    "F64",
    "F32",
    "F16",
    "BF16",
    "I64",
    "I32",
    "I16",
    "I8",
    "U8",
    "U16",
    "U32",
    "U64",
    "BOOL",
    "F8_E5M2",
    "C64",
    "X9",
    "",
    3,
)
_KINDS = (np.float64, np.float32, np.float16, np.int64, np.int32, np.int8, np.uint8, np.uint64, np.bool_)


def split(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return header and body of a whole safetensors file."""
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def joined(header: Any, body: bytes, dice: Random | None = None) -> bytes:
    """Return a safetensors file with this header."""
    text = json.dumps(header).encode() if dice is None else written(header, dice)
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + body


def faulty_tensors(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one fault in a safetensors file. Checksums are not repaired here."""
    kind = dice.choice(("numbers",) * 5 + ("arrays",) * 6 + ("entry",) * 3 + ("header", "metadata", "length", "names"))
    header, body = split(data)
    metadata = header.pop("__metadata__", None)
    kept = {} if metadata is None else {"__metadata__": metadata}
    if kind in ("numbers", "arrays", "names"):
        arrays = dict(sorted(safetensors.numpy.load(data).items()))  # in a fixed order
        name, arrays = _FAULTS[kind](arrays, dice)
        header, body = split(safetensors.numpy.save(arrays))
        return f"{kind} {name}", joined({**kept, **header}, body)
    if kind == "entry":
        name = dice.choice(list(header))
        entry = header[name]
        part = dice.choice(("dtype", "shape", "shape", "data_offsets", "data_offsets", "more"))
        if part == "dtype":
            entry["dtype"] = dice.choice(_DTYPES)
        elif part == "more":
            entry[dice.choice(("strides", "dtype ", ""))] = edge_value(dice)
        elif dice.random() < 0.3 or not entry[part]:
            entry[part] = edge_value(dice)
        elif dice.random() < 0.3:
            entry[part] = list(header[dice.choice(list(header))][part])
        else:
            entry[part][dice.randrange(len(entry[part]))] = edge_integer(dice)
        return f"entry {part}", joined({**kept, **header}, body, dice)
    if kind == "header":
        name, changed = faulty_json({**kept, **header}, dice)
        return f"header {name}", joined(changed, body, dice)
    if kind == "metadata":
        changed = dice.choice((edge_value(dice), faulty_json(metadata or {}, dice)[1], {"checksum": edge_value(dice)}))
        return kind, joined({"__metadata__": changed, **header}, body, dice)
    length = dice.choice((*INTEGERS[:20], len(data), len(data) - 8, len(data) - 7)) % 2**64
    return kind, length.to_bytes(8, "little") + data[8:]


def faulty_arrays(arrays: dict[str, np.ndarray], dice: Random) -> tuple[str, dict[str, np.ndarray]]:
    """Change sizes, axes or types of arrays, drop some, or add some."""
    name = dice.choice(list(arrays))
    array, kind = (
        arrays[name],
        dice.choice(("longer", "shorter", "none", "type", "type", "axis", "flat", "turned", "missing", "copy")),
    )
    axis = dice.randrange(max(1, array.ndim))
    if kind == "missing":
        return kind, {other: value for other, value in arrays.items() if other != name}
    if kind == "copy":
        return kind, {**arrays, name: arrays[dice.choice(list(arrays))]}
    if array.ndim == 0 and kind in ("longer", "shorter", "none", "turned"):
        kind = "axis"
    if kind == "longer":
        array = np.repeat(array, dice.choice((2, 3)), axis=axis)
    elif kind == "shorter":
        array = np.take(array, range(array.shape[axis] // 2), axis=axis)
    elif kind == "none":
        array = np.take(array, [], axis=axis)
    elif kind == "type":
        with np.errstate(all="ignore"):
            array = array.astype(dice.choice(_KINDS))
    elif kind == "axis":
        array = array[None] if dice.random() < 0.5 or not array.ndim else array[..., None]
    elif kind == "flat":
        array = array.reshape(-1)
    elif kind == "turned":
        array = array.T
    return kind, {**arrays, name: np.ascontiguousarray(array)}


def faulty_numbers(arrays: dict[str, np.ndarray], dice: Random) -> tuple[str, dict[str, np.ndarray]]:
    """Replace some or all numbers of one array by numbers at edges."""
    filled = [name for name, array in arrays.items() if array.size]
    if not filled:
        return "nothing", arrays
    name = dice.choice(filled)
    flat = arrays[name].reshape(-1).copy()
    if dice.random() < 0.2:
        places: Any = slice(None)
    else:
        places = [dice.randrange(len(flat)) for _ in range(dice.choice((1, 1, 3, 30)))]
    value: Any = edge_for(flat.dtype, dice)
    if dice.random() < 0.2:
        flat[places] = (
            flat[places] * np.array(dice.choice((-1, 2, 100)), flat.dtype) if flat.dtype.kind in "fi" else ~flat[places]
        )
        return "scaled", {**arrays, name: flat.reshape(arrays[name].shape)}
    flat[places] = value
    return f"{value:.3g}" if isinstance(value, float) else "integer", {**arrays, name: flat.reshape(arrays[name].shape)}


def edge_for(dtype: np.dtype, dice: Random) -> float | int | bool:
    """Return a number at an edge of a type."""
    if dtype.kind == "f":
        value = dice.choice(FLOATS)
        with np.errstate(all="ignore"):
            return float(np.array(value).astype(dtype))
    if dtype.kind == "b":
        return dice.random() < 0.5
    limits = np.iinfo(dtype)
    return dice.choice((limits.min, limits.max, *(value for value in INTEGERS if limits.min <= value <= limits.max)))


def _renamed(arrays: dict[str, np.ndarray], dice: Random) -> tuple[str, dict[str, np.ndarray]]:
    name = dice.choice(list(arrays))
    other = dice.choice((name + "s", name.upper(), "", "x" * 10_000, "a\x1b[31m", "__metadata", *arrays))
    return "rename", {other if key == name else key: value for key, value in arrays.items()}


_FAULTS = {"numbers": faulty_numbers, "arrays": faulty_arrays, "names": _renamed}
