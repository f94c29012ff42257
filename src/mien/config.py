"""Settings as json: nested frozen dataclasses, with a `kind` wherever a field may hold one of several classes."""

import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from torch import Tensor

from mien.errors import UserError


def encode(value: Any, stash: Callable[[Tensor], Any] | None = None) -> Any:
    """Settings as what json can hold; every dataclass becomes an object with its class name as `kind`.

    Tensors become what `stash` returns for them; without it they are not allowed.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {"kind": type(value).__name__, **{f.name: encode(getattr(value, f.name), stash) for f in fields(value)}}
    if isinstance(value, (tuple, list)):
        return [encode(item, stash) for item in value]
    if isinstance(value, Mapping):
        return {str(key): encode(item, stash) for key, item in value.items()}
    if isinstance(value, Tensor) and stash is not None:
        return stash(value)
    if isinstance(value, Path):
        return str(value)
    assert value is None or isinstance(value, (bool, int, float, str)), f"settings cannot hold {type(value)}"
    return value


def decode(hint: Any, value: Any, where: str = "settings") -> Any:
    """What `encode` encoded, as the type `hint`; fields that are missing get their defaults, tensors stay as they are.

    Raises:
        UserError: a field is unknown, is missing without a default, or has a value of another type.
    """
    if isinstance(value, Tensor):
        return value
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _decode_union(get_args(hint), value, where)
    if is_dataclass(hint):
        return _decode_dataclass(hint, value, where)
    if origin is tuple and isinstance(value, list):
        items = get_args(hint)
        kinds = [items[0]] * len(value) if len(items) == 2 and items[1] is Ellipsis else items
        return tuple(decode(kind, item, where) for kind, item in zip(kinds, value, strict=True))
    if origin is dict and isinstance(value, dict):
        return {key: decode(get_args(hint)[1], item, where) for key, item in value.items()}
    if origin is Literal and value in get_args(hint):
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if origin is None and isinstance(hint, type) and isinstance(value, hint):
        return value
    raise UserError(f"{where}: {value!r} is not a {hint}; made by another version of mien? Make it again")


def _decode_dataclass(hint: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise UserError(f"{where}: {value!r} is not a {hint.__name__}; make the folder again")
    hints = get_type_hints(hint)
    known = {f.name: f for f in fields(hint)}
    unknown = set(value) - set(known) - {"kind"}
    missing = [
        name for name, f in known.items() if name not in value and f.default is MISSING and f.default_factory is MISSING
    ]
    if unknown or missing:
        raise UserError(
            f"{where}: unknown {sorted(unknown)}, missing {missing}: made by another version of mien; make it again"
        )
    return hint(**{name: decode(hints[name], value[name], f"{where}.{name}") for name in known if name in value})


def _decode_union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in options:
        return None
    if isinstance(value, dict) and "kind" in value:
        for option in options:
            if is_dataclass(option) and isinstance(option, type) and option.__name__ == value["kind"]:
                return _decode_dataclass(option, value, where)
    plain = [option for option in options if not is_dataclass(option) and option is not type(None)]
    for option in plain:
        try:
            return decode(option, value, where)
        except UserError:
            continue
    raise UserError(f"{where}: {value!r} is none of {options}; made by another version of mien? Make it again")
