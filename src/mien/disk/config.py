"""Settings as json: nested frozen dataclasses, with a `kind` wherever a field may hold one of several classes."""

import contextlib
import difflib
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from mien.errors import UserError

_MAX_SHOWN = 60
"""Number of characters of a value that a message shows."""


@dataclass(frozen=True)
class Range:
    """The numbers from `least` to `most`, both included, but never NaN.

    A tuple is in range if each of its entries is.
    """

    least: float | int
    most: float | int
    or_zero: bool = False
    """Whether 0 is allowed as well, to switch something off."""
    ascending: bool = False
    """Whether each entry of a tuple must be larger than the one before it."""
    filled: bool = False
    """Whether a tuple needs at least one entry."""
    words: str = ""
    """Description of the range in messages. If it is empty, the bounds are shown."""

    def holds(self, value: Any) -> bool:
        """Whether a number, or every number of a tuple, is in range. None, which means no number, always is."""
        if value is None:
            return True
        numbers = value if isinstance(value, tuple) else (value,)
        if self.filled and not numbers:
            return False
        if self.ascending and any(later <= before for before, later in zip(numbers, numbers[1:], strict=False)):
            return False
        return all(self.least <= number <= self.most or (self.or_zero and number == 0) for number in numbers)

    def __str__(self) -> str:
        """The range as text: "from 0 to 3"."""
        return self.asked("")

    def asked(self, numbers: str) -> str:
        """The range with the kind of number that `numbers` names: "a number from 0 to 3"."""
        bounds = self.words or f"{numbers} from {_short(self.least)} to {_short(self.most)}".strip()
        return ("0, or " if self.or_zero else "") + bounds + (", ascending" if self.ascending else "")


@dataclass(frozen=True)
class NotBelow:
    """A mark beside a field: its number must not be smaller than that of another field of the same settings."""

    other: str
    above: bool = False
    """Whether it must even be larger."""


@dataclass(frozen=True)
class ToLoad:
    """A mark beside a field that matters only when a new avatar is made.

    An avatar whose tensors will be loaded from a file is built with this value, so that no unneeded tensors are made.
    """

    value: int


FRACTION = Range(0, 1)
"""Range of a share, an opacity, or a time as a fraction of the run."""
POSITIVE = Range(1e-9, 1e9, words=f"a number above 0, at most {1e9:g}")
"""Range of a length or a scale."""
NOT_NEGATIVE = Range(0, 1e9)
"""Range of a weight that may be switched off."""
COUNT = Range(1, 100_000)
COUNT_OR_NONE = Range(0, 100_000)


def check_ranges(settings: Any, option: Callable[[str], str]) -> None:
    """Check every number of some settings, and of nested settings, against the range beside its field.

    `option` turns the dotted name of a field into the option that sets it: `density.rounds` ->
    "--method.density.rounds".
    """
    hints = _hints_of(type(settings))
    for field in fields(settings):
        value, hint = getattr(settings, field.name), hints[field.name]
        if is_dataclass(value):
            check_ranges(value, lambda name, group=field.name: option(f"{group}.{name}"))
            continue
        allowed = range_of(hint)
        if allowed is not None:
            check_range(value, allowed, option(field.name))
        for mark in marks_of(hint):
            if isinstance(mark, NotBelow):
                least = getattr(settings, mark.other)
                if value < least or (mark.above and value == least):
                    asked = "more than" if mark.above else "at least as much as"
                    other = f"{option(mark.other)} {shown(least)}"
                    raise UserError(f"{option(field.name)} {shown(value)}: give {asked} {other}")


def check_range(value: Any, allowed: Range, option: str) -> None:
    """Check one value."""
    if not allowed.holds(value):
        asked = allowed.asked("numbers" if isinstance(value, tuple) else "a number")
        raise UserError(f"{option} {shown(value)}: give {asked}")


def range_of(hint: Any) -> Range | None:
    """The range in a field's type hint, if it has one."""
    return next((mark for mark in marks_of(hint) if isinstance(mark, Range)), None)


def shown(value: Any) -> str:
    """A setting's value as a short text."""
    if isinstance(value, (tuple, list)):
        text = " ".join(shown(item) for item in value) or "(nothing)"
    else:
        text = _short(value) if isinstance(value, float) else str(value)
    return text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + "..."


def marks_of(hint: Any) -> tuple[Any, ...]:
    """The marks in a field's type hint, besides its type."""
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


@cache
def _hints_of(kind: type) -> dict[str, Any]:
    """The type hints of a dataclass, with the marks beside them."""
    return get_type_hints(kind, include_extras=True)


def _short(number: float | int) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


def encode(value: Any) -> Any:
    """Settings as values that json can hold. Every dataclass becomes an object with its class name as `kind`."""
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


def decode(hint: Any, value: Any, where: str = "settings", remedy: str = "make it again") -> Any:
    """Decode what `encode` encoded into the type `hint`. Every field is there, also one with a default."""
    try:
        return _decode(hint, value, where)
    except UserError as error:
        raise UserError(f"{error} (made by another version of mien?); {remedy}") from None


def overlay(base: Any, changes: Any, where: str, owner: str) -> Any:
    """Settings with some fields changed to values from json. All other fields stay, also in nested settings.

    `changes` may have a `kind`, as in the output of `encode`. Messages name the place `where` ("config.json: method"),
    and for an unknown setting the `owner` of the settings.
    """
    if not isinstance(changes, dict):
        raise UserError(f"{where} {_in_short(changes)}: give an object of settings, {{...}}")
    if changes.get("kind", type(base).__name__) != type(base).__name__:
        raise UserError(f"{where}.kind {_in_short(changes['kind'])}: give {type(base).__name__!r}, or leave it out")
    hints = _hints_of(type(base))
    known = [f.name for f in fields(base)]
    changed = {}
    for name, change in changes.items():
        if name == "kind":
            continue
        if name not in known:
            near = difflib.get_close_matches(name[:_MAX_SHOWN_NAMES], known, 1)
            raise UserError(no_such_setting(f"{where}.{name[:_MAX_SHOWN_NAMES]}", owner, near, known))
        place, value = f"{where}.{name}", getattr(base, name)
        if is_dataclass(value):
            changed[name] = overlay(value, change, place, owner)
            continue
        plain = get_args(hints[name])[0] if get_origin(hints[name]) is Annotated else hints[name]
        try:
            changed[name] = _decode(plain, change, place)
        except UserError:
            raise UserError(f"{place} {_in_short(change)}: give {_in_words(plain)}") from None
        if (allowed := range_of(hints[name])) is not None:
            check_range(changed[name], allowed, place)
    return replace(base, **changed)


def for_loading(settings: Any) -> Any:
    """The same settings, with the smallest values of those that matter only for a new avatar (`ToLoad`)."""
    hints = _hints_of(type(settings))
    marks = {name: mark for name, hint in hints.items() for mark in marks_of(hint) if isinstance(mark, ToLoad)}
    return replace(settings, **{name: mark.value for name, mark in marks.items()})


def no_such_setting(given: str, owner: str, near: Sequence[str], known: Sequence[str]) -> str:
    """The message about an unknown setting: the nearest name, if one is near, and all names."""
    hint = f"did you mean {near[0]}? " if near else ""
    return f"{given}: {owner} has no such setting; {hint}there are: {', '.join(known)}"


def _in_words(hint: Any) -> str:
    """Describe the values that a setting of some type may have in a json file."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(str(part) for part in parts)
    if origin is tuple:
        return f"a list, each entry {_in_words(parts[0])}"
    if origin in (Union, types.UnionType):
        return " or ".join(_in_words(part) for part in parts)
    plain = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", type(None): "null"}
    return plain.get(hint, f"a {getattr(hint, '__name__', hint)}")


def _decode(hint: Any, value: Any, where: str) -> Any:
    if hint is Any:
        return value
    origin = get_origin(hint)
    if origin is Annotated:
        found = _decode(get_args(hint)[0], value, where)
        if (allowed := range_of(hint)) is not None:
            check_range(found, allowed, where)
        return found
    if origin in (Union, types.UnionType):
        return _decode_union(get_args(hint), value, where)
    if is_dataclass(hint):
        return _decode_dataclass(hint, value, where)
    if origin is tuple and isinstance(value, list):
        items = get_args(hint)
        kinds = [items[0]] * len(value) if len(items) == 2 and items[1] is Ellipsis else items
        if len(kinds) != len(value):
            raise UserError(f"{where}: has {len(value)} entries instead of {len(kinds)}")
        return tuple(_decode(kind, item, where) for kind, item in zip(kinds, value, strict=True))
    if origin is dict and isinstance(value, dict):
        return {key: _decode(get_args(hint)[1], item, where) for key, item in value.items()}
    # Do not compare arrays, which compare entry by entry.
    if origin is Literal and isinstance(value, (str, int)) and value in get_args(hint):
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):  # a whole number with hundreds of digits
            return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    # True is an int in Python, but not for people.
    alike = isinstance(value, bool) == (hint is bool)
    if origin is None and isinstance(hint, type) and isinstance(value, hint) and alike:
        return value
    raise UserError(f"{where}: {_in_short(value)} is not {_in_words(hint)}")


def _decode_dataclass(hint: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise UserError(f"{where}: {_in_short(value)} is not a {hint.__name__}")
    hints = _hints_of(hint)
    known = [f.name for f in fields(hint)]
    unknown, missing = set(value) - {*known, "kind"}, [name for name in known if name not in value]
    if unknown or missing:
        faults = [f"has unknown entries {_in_short(sorted(unknown))}"] if unknown else []
        faults += [f"lacks {_in_short(missing)}"] if missing else []
        raise UserError(f"{where}: {' and '.join(faults)}")
    return hint(**{name: _decode(hints[name], value[name], f"{where}.{name}") for name in known})


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
    raise UserError(f"{where}: {_in_short(value)} is not {' or '.join(map(_in_words, options))}")


def _in_short(value: Any) -> str:
    """A value as one short line."""
    shape = getattr(value, "shape", None)
    if shape is not None:
        return f"{value.dtype} {tuple(shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= _MAX_SHOWN_NAMES else text[:_MAX_SHOWN_NAMES] + "..."


_MAX_SHOWN_NAMES = 80
