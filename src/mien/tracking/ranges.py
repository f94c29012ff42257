"""Which values a user's settings may have, told before any work."""

import math
from collections.abc import Mapping
from typing import Any

from mien.errors import UserError

POSITIVE = (1e-9, 1e9)
"""Of a scale."""
NOT_NEGATIVE = (0.0, 1e9)
"""Of a weight that may be switched off."""
COUNT = (1, 100_000)
COUNT_OR_NONE = (0, 100_000)
TEXELS = (16, 8192)
"""Along a side of a texture."""


def check_ranges(settings: Any, option: str, ranges: Mapping[str, tuple[float | int, float | int]]) -> None:
    """Check fields of settings, numbers or tuples of them, by the least and the greatest value that makes sense.

    Args:
        settings: A dataclass.
        option: How its options begin on the command line: "--tracking.".
        ranges: By the fields' names.

    Raises:
        UserError: names the first option and value that is not one of these, and the range.
    """
    for name, (least, most) in ranges.items():
        value = getattr(settings, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if numbers and all(math.isfinite(number) and least <= number <= most for number in numbers):
            continue
        given = " ".join(f"{number:g}" for number in numbers) or "(nothing)"
        wanted = {
            POSITIVE: f"a number above 0, {most:g} at most",
            NOT_NEGATIVE: f"0 or a number above it, {most:g} at most",
        }.get((least, most), f"a number from {least:g} to {most:g}")
        raise UserError(f"{option}{name.replace('_', '-')} {given}: give {wanted}")
