"""The one door to the terminal: what people read is made harmless first, on standard error and on standard output.

A file name may hold any character. An escape sequence in one would move the cursor, clear the screen or retitle the
window of whoever reads a message about it, and a line break would make two messages of one.
"""

import os
import sys
import unicodedata

from mien.errors import UserError

_HIDDEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Categories of Unicode: controls, formats such as the reversal of text, halves of characters, ends of lines."""
_JOINERS = frozenset("\u200c\u200d")
"""Formats that belong to words and emoji."""
_FIRST_BYTE, _LAST_BYTE = "\udc80", "\udcff"
"""What Python makes of bytes in file names that are no UTF-8."""


def printable(text: str, *, lines: bool = False) -> str:
    r"""The text with every character that would act instead of being seen written as \x1b, \n and the like.

    Args:
        text: what is to be shown.
        lines: whether line breaks stay what they are: for tables, never for messages.
    """
    if text.isprintable():
        return text
    return "".join(_seen(character) if _acts(character, lines) else character for character in text)


def plain_name(text: str) -> str:
    """A name made from a file's: with "_" for every character that acts, so that it can be written down anywhere."""
    return "".join("_" if _acts(character, False) else character for character in text)


def show(text: str, *, styled: bool = False) -> None:
    """Print a result, one or several lines, on standard output.

    Args:
        text: the result.
        styled: whether it has escape sequences of ours; names in it are made `printable` by who puts them there.

    Raises:
        BrokenPipeError: whoever read standard output has closed it.
        UserError: it cannot be written.
    """
    try:
        print(text if styled else printable(text, lines=True), flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise UserError(f"standard output: cannot be written ({error.strerror}); mend that and run it again") from None


def tell(message: str) -> None:
    """Print one line for people on standard error, without the libraries that draw progress bars."""
    print(printable(message), file=sys.stderr, flush=True)


def open_closed_streams() -> None:
    """Give standard streams that were closed (`>&-`) a place where everything is dropped.

    Otherwise the next file that is opened gets their number, and what a library prints ends up in it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            handle = os.open(os.devnull, os.O_RDWR)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if name == "stdin" else "w", encoding="utf-8", closefd=False))  # noqa: SIM115, PTH123


def drop_output() -> None:
    """Send what is still to be printed nowhere: whoever read it is gone, and Python would complain of it at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _acts(character: str, lines: bool) -> bool:
    if character in _JOINERS or (lines and character == "\n"):
        return False
    return unicodedata.category(character) in _HIDDEN


def _seen(character: str) -> str:
    if _FIRST_BYTE <= character <= _LAST_BYTE:
        return f"\\x{ord(character) - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
