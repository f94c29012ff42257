"""mien tells of wrong options in one line, in the words of its other messages. tyro finds what is wrong."""

import contextlib
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from mien.commands.parsing.settings_options import near_option

_USELESS = ("For full helptext", "Argument helptext")
_REWORDED = (
    (r"^Error parsing (\S+): invalid literal for int\(\) with base 10: ", r"\1: give a whole number instead of "),
    (r"^Error parsing (\S+): could not convert string to float: ", r"\1: give a number instead of "),
    (r"^Error parsing (\S+): no type matching (.+?) could be .*? from \[(.*?)\].*", r"\1: give \2 instead of \3"),
    (r"^invalid choice (.*) for argument '(.+?)'\. Expected one of \((.*?),?\)", r"\2: give one of \3 instead of \1"),
    (r"^Missing value for argument '(.+?)'\. Expected .* values", r"\1: give it a value"),
    (r"^Missing from mien [\w -]+: ", "missing: "),
    (r"^Unrecognized options: ", "unknown: "),
    (r"^Expected one of \{(.*)\}", r"give one of \1"),
    (r"^Available subcommands: ", "there are: "),
    (r"^Perhaps you meant: ", "did you mean "),
)
"""Beginnings of tyro's complaints, and what mien says instead."""
_INDENT_OF_DESCRIPTION = 8
"""Number of spaces before an option's description in tyro's messages. Option names have fewer."""


def complaint_of(box: str, arguments: Sequence[str], options: type, style: Any) -> str:
    """Return one line that names the option, its value, and what to give.

    Args:
        box: What tyro printed.
        arguments: What was typed after the name of the command.
        options: The options that it was given.
        style: Its configuration.
    """
    return _unknown_options(arguments, options, style) or _with_choices_in_order(_in_one_line(box), options)


def _in_one_line(box: str) -> str:
    """One line from the box in which tyro reports wrong arguments, without the descriptions of options."""
    lines = box.splitlines()
    # If the terminal has no Unicode, the box is a title, a line of dashes, and the content indented by two spaces.
    lines = lines[1:] if "╭" in box else lines[2:]
    parts: list[str] = [""]
    for line in lines:
        if line.startswith("╰"):
            continue
        inner = line[2:].removesuffix("│").rstrip()
        text = inner.strip()
        if text and not text.strip("─-"):
            parts.append("")
        elif len(inner) - len(inner.lstrip()) < _INDENT_OF_DESCRIPTION:
            comma = inner.startswith(" ") and parts[-1] and not parts[-1].endswith(":")
            parts[-1] = f"{parts[-1]}{',' if comma else ''} {text}".strip()
    return "; ".join(_reworded(part.rstrip(".")) for part in parts if part and not part.startswith(_USELESS))


def _with_choices_in_order(complaint: str, options: type) -> str:
    """A complaint of a wrong choice, with the choices as they are declared.

    tyro keeps the choices of an option that may be left out in a set, together with None, which nobody can type.
    """

    def ordered(listed: re.Match[str]) -> str:
        found = [choice for choice in re.findall(r"'([^']*)'", listed[1]) if choice != "None"]
        declared = next((each for each in _choices(options, set()) if sorted(each) == sorted(found)), found)
        return f"give one of {', '.join(map(repr, declared))} instead of"

    complaint = re.sub(
        r"give \{([\w,. -]+)\} instead of",
        lambda listed: f"give one of {', '.join(map(repr, re.findall(r'[^, ]+', listed[1])))} instead of",
        complaint,
    )
    return re.sub(r"give one of ('.*') instead of", ordered, complaint)


def _choices(hint: Any, seen: set[Any]) -> Iterator[list[str]]:
    """Yield the choices of each option of a type, in the order of their declaration."""
    if get_origin(hint) is Literal:
        yield [str(choice) for choice in get_args(hint)]
    elif isinstance(hint, type) and is_dataclass(hint):
        if hint not in seen:
            seen.add(hint)
            for one in get_type_hints(hint).values():
                yield from _choices(one, seen)
    else:
        for one in get_args(hint):
            yield from _choices(one, seen)


def _unknown_options(arguments: Sequence[str], options: type, style: Any) -> str | None:
    """One line about the options that do not exist, with the existing ones that look like them; None if all exist.

    tyro takes what follows an unknown option for something else, and complains about that.
    """
    import tyro

    shown, told = io.StringIO(), io.StringIO()
    # A sub-command has options of its own.
    first = [argument for argument in arguments[:1] if not argument.startswith("-")]
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(told), contextlib.suppress(SystemExit):
        tyro.cli(options, args=[*first, "--help"], config=style)
    if not shown.getvalue():
        return None  # there is no such sub-command
    known = [*re.findall(r"(?<![\w.-])--[a-z][\w.-]*", shown.getvalue()), "--help-all"]
    names = [argument.partition("=")[0].replace("_", "-") for argument in arguments]
    unknown = [name for name in dict.fromkeys(names) if re.match("--[a-z]", name) and name not in known]
    if not unknown:
        return None
    near = [found for name in unknown for found in near_option(name, known)]
    hint = f"; did you mean {', '.join(dict.fromkeys(near))}?" if near else ""
    return f"unknown: {', '.join(unknown)}{hint}"


def _reworded(complaint: str) -> str:
    """A complaint of tyro in the words of mien's own messages: the option, its value, and what to give."""
    for pattern, words in _REWORDED:
        complaint = re.sub(pattern, words, complaint)
    return complaint
