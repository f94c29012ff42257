"""Settings as json: nested frozen dataclasses, with a `kind` wherever a field may hold one of several classes."""

import sys
import types
from collections.abc import Mapping
from dataclasses import MISSING, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from mien.errors import UserError


def encode(value: Any) -> Any:
    """Settings as what json can hold; every dataclass becomes an object with its class name as `kind`."""
    if is_dataclass(value) and not isinstance(value, type):
        return {"kind": type(value).__name__, **{f.name: encode(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, (tuple, list)):
        return [encode(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): encode(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    assert value is None or isinstance(value, (bool, int, float, str)), f"settings cannot hold {type(value)}"
    return value


def ranged(default: Any, low: int | float, high: int | float, *, to_load: Any = None) -> Any:
    """A field of settings that `decode` refuses beyond some bounds: sizes ask for memory and time.

    Args:
        default: its default.
        low: the least that may be read.
        high: the most.
        to_load: what an avatar is built with when its tensors are about to be loaded (`for_loading`), if that is less.
    """
    return field(default=default, metadata={"range": (low, high), "to_load": to_load})


def for_loading(settings: Any) -> Any:
    """The same settings with the least of what counts only when an avatar is begun."""
    least = {f.name: f.metadata["to_load"] for f in fields(settings) if f.metadata.get("to_load") is not None}
    return replace(settings, **least)


def decode(hint: Any, value: Any, where: str = "settings", remedy: str = "make it again") -> Any:
    """What `encode` encoded, as the type `hint`; fields that are missing get their defaults.

    Raises:
        UserError: a field is unknown, is missing without a default, or has a value of another type; ends in `remedy`.
    """
    try:
        return _decode(hint, value, where)
    except UserError as error:
        raise UserError(f"{error} (made by another version of mien?); {remedy}") from None


def _decode(hint: Any, value: Any, where: str) -> Any:
    if hint is Any:
        return value
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _decode_union(get_args(hint), value, where)
    if is_dataclass(hint):
        return _decode_dataclass(hint, value, where)
    if origin is tuple and isinstance(value, list):
        items = get_args(hint)
        kinds = [items[0]] * len(value) if len(items) == 2 and items[1] is Ellipsis else items
        if len(kinds) != len(value):
            raise UserError(f"{where}: {len(value)} entries instead of {len(kinds)}")
        return tuple(_decode(kind, item, where) for kind, item in zip(kinds, value, strict=True))
    if origin is dict and isinstance(value, dict):
        return {key: _decode(get_args(hint)[1], item, where) for key, item in value.items()}
    # Not asked of arrays, which compare by their items.
    if origin is Literal and isinstance(value, (str, int)) and value in get_args(hint):
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not abs(value) <= sys.float_info.max:
            raise UserError(f"{where}: {_in_short(value)} is no finite number")
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    # True is an int to Python, not to people.
    alike = isinstance(value, bool) == (hint is bool)
    if origin is None and isinstance(hint, type) and isinstance(value, hint) and alike:
        return value
    raise UserError(f"{where}: {_in_short(value)} is not a {hint}")


def _decode_dataclass(hint: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise UserError(f"{where}: {_in_short(value)} is not a {hint.__name__}")
    hints = get_type_hints(hint)
    known = {f.name: f for f in fields(hint)}
    unknown = set(value) - set(known) - {"kind"}
    missing = [
        name for name, f in known.items() if name not in value and f.default is MISSING and f.default_factory is MISSING
    ]
    if unknown or missing:
        raise UserError(f"{where}: unknown {sorted(unknown)}, missing {missing}")
    found = {name: _decode(hints[name], value[name], f"{where}.{name}") for name in known if name in value}
    for name, item in found.items():
        low, high = known[name].metadata.get("range", (None, None))
        if low is not None and not low <= item <= high:
            raise UserError(f"{where}.{name}: {_in_short(item)} is not within {low} to {high}")
    return hint(**found)


def _decode_union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in options:
        return None
    if isinstance(value, dict) and isinstance(value.get("kind"), str):
        for option in options:
            if is_dataclass(option) and isinstance(option, type) and option.__name__ == value["kind"]:
                return _decode_dataclass(option, value, where)
    plain = [option for option in options if not is_dataclass(option) and option is not type(None)]
    for option in plain:
        try:
            return _decode(option, value, where)
        except UserError:
            continue
    raise UserError(f"{where}: {_in_short(value)} is none of {options}")


def _in_short(value: Any) -> str:
    """One line, whatever it is."""
    shape = getattr(value, "shape", None)
    if shape is not None:
        return f"{value.dtype} {tuple(shape)}"
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + "..."


_LONGEST_SHOWN = 80
