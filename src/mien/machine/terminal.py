"""The one way to print: text for people is made harmless first, on standard error and on standard output.

A file name may hold any character. An escape sequence in a name could move the cursor, clear the screen or change the
window's title when a message about the file is printed, and a line break would split the message in two.
"""

import os
import sys
import unicodedata

from mien.errors import UserError

_HIDDEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Unicode categories: control characters, format characters such as the reversal of text, halves of surrogate pairs,
line and paragraph separators."""


def printable(text: str, *, lines: bool = False) -> str:
    r"""The text with every control or format character written as an escape such as \x1b or \n.

    With `lines`, line breaks stay as they are. This is for tables, never for messages.
    """
    if text.isprintable():
        return text
    return "".join(_seen(character) if _acts(character, lines) else character for character in text)


def plain_name(text: str) -> str:
    """A name derived from a file's name: every control or format character becomes "_", so that it is safe anywhere."""
    return "".join("_" if _acts(character, False) else character for character in text)


def counted(count: int, noun: str) -> str:
    """A number with its noun: "1 frame", "2 frames", "12,000 frames"."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def show(text: str, *, styled: bool = False) -> None:
    """Print a result, which may have several lines, on standard output.

    Text that is `styled` has escape sequences of mien, and its caller makes the names in it `printable`. A
    BrokenPipeError says that the reader has closed standard output.
    """
    try:
        print(text if styled else printable(text, lines=True), flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise UserError(
            f"standard output: cannot be written ({error.strerror}); correct that and run the command again"
        ) from None


def tell(message: str) -> None:
    """Print one line for people on standard error. This needs no library for progress bars."""
    print(printable(message), file=sys.stderr, flush=True)


def open_closed_streams() -> None:
    """Redirect standard streams that were closed (`>&-`) to the null device.

    Otherwise the next file that is opened gets the number of a closed stream, and output of libraries ends up in it.
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
    """Discard output that cannot be written because its reader is gone; Python would complain about it at exit."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _acts(character: str, lines: bool) -> bool:
    if character in "\u200c\u200d" or (lines and character == "\n"):  # two joiners belong to words and emoji
        return False
    return unicodedata.category(character) in _HIDDEN


def _seen(character: str) -> str:
    if "\udc80" <= character <= "\udcff":  # a byte of a file name that is not UTF-8
        return f"\\x{ord(character) - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
