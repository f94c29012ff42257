"""What users do wrong is refused by a `UserError` of one line."""

from collections.abc import Callable
from typing import Any

import pytest

from mien.errors import UserError


def refuses(words: str, call: Callable[..., Any], *given: Any, **named: Any) -> str:
    """Make a call that must raise a `UserError` of one line with these words, a pattern, and return the line."""
    with pytest.raises(UserError, match=words) as error:
        call(*given, **named)
    line = str(error.value)
    assert "\n" not in line
    return line
