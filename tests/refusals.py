"""What users do wrong is refused in one line: by a `UserError`, and by commands."""

from collections.abc import Callable
from typing import Any

import pytest

from mien.cli import EXIT_USER_ERROR, main
from mien.errors import UserError


def refuses(words: str, call: Callable[..., Any], *given: Any, **named: Any) -> str:
    """Make a call that must raise a `UserError` of one line with these words, a pattern, and return the line."""
    with pytest.raises(UserError, match=words) as error:
        call(*given, **named)
    line = str(error.value)
    assert "\n" not in line
    return line


def complaint(capsys: pytest.CaptureFixture[str], *words: object, alone: bool = True) -> str:
    """Run a command that must be refused in one line, alone or after what it says of its work; return the line."""
    capsys.readouterr()
    assert main(list(map(str, words))) == EXIT_USER_ERROR
    (line,) = (
        text for text in capsys.readouterr().err.splitlines() if text.strip() and (alone or text.startswith("mien: "))
    )
    assert line.startswith("mien: ")
    return line
