"""Ranges of the numbers in settings. Each range is written beside its field, and all are checked in one place.

    rounds: Annotated[int, Range(0, 100_000)] = 16

Everything here is plain Python, because settings are read and checked before any heavy library is imported.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

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


@dataclass(frozen=True)
class Above:
    """A mark beside a field: its number must be larger than that of another field of the same settings."""

    other: str


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

    Args:
        settings: A dataclass.
        option: Turns the dotted name of a field into the option that sets it: `density.rounds` ->
            "--method.density.rounds".
    """
    hints = get_type_hints(type(settings), include_extras=True)
    for field in fields(settings):
        value, hint = getattr(settings, field.name), hints[field.name]
        if is_dataclass(value):
            check_ranges(value, lambda name, group=field.name: option(f"{group}.{name}"))
            continue
        allowed = range_of(hint)
        if allowed is not None:
            check_range(value, allowed, option(field.name))
        for mark in marks_of(hint):
            if isinstance(mark, NotBelow) and value < getattr(settings, mark.other):
                other = f"{option(mark.other)} {shown(getattr(settings, mark.other))}"
                raise UserError(f"{option(field.name)} {shown(value)}: give at least as much as {other}")
            if isinstance(mark, Above) and value <= getattr(settings, mark.other):
                other = f"{option(mark.other)} {shown(getattr(settings, mark.other))}"
                raise UserError(f"{option(field.name)} {shown(value)}: give more than {other}")


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


def _short(number: float | int) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"
