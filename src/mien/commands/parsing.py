"""Between tyro and the commands: tasks of a command, help at a glance, and complaints in one line."""

import ast
import contextlib
import inspect
import io
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache, partial
from types import FunctionType, ModuleType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro

from mien.commands.train_options import TrainOptions
from mien.disk.config import Range, check_range, shown
from mien.errors import UserError
from mien.machine.terminal import show

_STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
_NOT_A_NUMBER = re.compile(r"Error parsing (--\S+): [^;]*?(int|float)\b[^;]*: ('[^']*')")
"""Matches what tyro and Python say of a text that is no number."""
_FIRST = {
    "create": ("out", "name", "preset", "method", "device", "view"),
    "render": ("out", "run", "set", "path", "motion", "yaw", "size", "background"),
    "drive": ("by", "out", "run", "neutral", "alone", "size"),
    "batch": ("out", "paper", "subjects", "on", "retry", "jobs", "shard"),
}
"""Commands with many options: the only ones that `--help` shows of them. `--help-all` shows all."""
_COMMON = {
    "capture": ("size", "crop", "start", "end", "turn", "stride", "fps", "cuts", "clean-plate", "mattes"),
    "tracking": ("focal", "same-camera", "schedule"),
    "alignment": ("when",),
    "scoring": (),
    "training": (),
    "method": (),
}
"""The options that `--help` shows of each group of settings."""


def parse(module: ModuleType, name: str, arguments: Sequence[str]) -> Any:
    """The command of a module with its options, as they were typed. Help ends the program.

    A module has a dataclass `Command`, or `TASKS`: a dataclass for each word that may follow the name of the command.
    The task "" is that without such a word. Or it has `task_of`, which picks the dataclass by the arguments.
    """
    rest, tasks = list(arguments), getattr(module, "TASKS", None)
    tasks = tasks or {"": module.task_of(rest) if hasattr(module, "task_of") else module.Command}
    task = rest.pop(0) if rest and rest[0] in tasks else ""
    prog = f"mien {name} {task}".rstrip()
    if task not in tasks:
        listed = "\n".join(f"  {each:<12} {str(kind.__doc__).splitlines()[0]}" for each, kind in tasks.items())
        if not {"-h", "--help", "--help-all"} & {*rest}:
            raise UserError(f"{' '.join([prog, *rest[:1]])}: give one of {', '.join(tasks)}; see {prog} --help")
        show(f"usage: {prog} TASK [options]\n\n{module.__doc__}\n\n{listed}")
        raise SystemExit(0)
    return parse_options(tasks[task], prog, rest)


def parse_options(kind: type, prog: str, arguments: Sequence[str]) -> Any:
    """The options of a command. Their defaults are those of the preset and the file that the arguments name."""
    default, names = with_defaults(kind, arguments), [argument.partition("=")[0] for argument in arguments]
    parts = [default, *(part for part in vars(default).values() if is_dataclass(part))]
    for name in (name for part in parts for name, value in vars(part).items() if isinstance(value, tuple)):
        if names.count(option := f"--{name.replace('_', '-')}") > 1:
            # The first of its values would be dropped without a word.
            raise UserError(f"{option} is given twice; give it once, followed by all of its values")
    if {"-h", "--help", "--help-all"} & {*arguments}:
        _help(kind, prog, arguments)
    told, more = io.StringIO(), getattr(kind, "takes_more", False)
    try:
        with contextlib.redirect_stderr(told):
            found = tyro.cli(kind, prog=prog, args=arguments, default=default, config=_STYLE, return_unknown_args=more)
    except SystemExit:
        complaint, remedies = in_one_line(told.getvalue()), getattr(kind, "remedies", {})
        unknown = names if "Unrecognized" in complaint else []
        remedy = "".join({f"{each}; " for start, each in remedies.items() if any(n.startswith(start) for n in unknown)})
        raise UserError(f"{complaint}; {remedy}see {prog} --help-all") from None
    command = replace(found[0], for_all=tuple(found[1])) if more else found
    for name, option, _, marks in _named_fields(type(command), ""):  # groups of settings check themselves
        for allowed in (mark for mark in marks if isinstance(mark, Range)):
            check_range(getattr(command, name), allowed, f"--{option}")
    return command


def with_defaults(command: type, arguments: Sequence[str]) -> Any:
    """A command with its defaults. What must be given is `tyro.MISSING`."""
    hints, whole = get_type_hints(command), object.__new__(command)
    for one in fields(command):
        if hints[one.name] is TrainOptions:
            value: Any = TrainOptions.chosen(arguments)
        elif one.default_factory is not MISSING:
            value = one.default_factory()
        else:
            value = tyro.MISSING if one.default is MISSING else one.default
        object.__setattr__(whole, one.name, value)
    return whole


def in_one_line(box: str) -> str:
    """Return the text of tyro's box of a complaint, without the descriptions of options."""
    # If the terminal has no Unicode, the box is a title, a line of dashes, and the content indented by two spaces.
    lines, parts = box.splitlines()[1 if "╭" in box else 2 :], [""]
    for line in lines:
        text = line[2:].removesuffix("│").rstrip()
        if not text.strip("─- ╰╯"):
            parts.append("")
        elif len(text) - len(text.lstrip()) < 8:  # descriptions are further in
            parts[-1] = f"{parts[-1]} {text.strip()}".strip()
    useless = ("For full helptext", "Argument helptext", "Got errors")
    return _NOT_A_NUMBER.sub(
        lambda found: f"{found[1]}: {found[3]} is not a {'whole ' * (found[2] == 'int')}number",
        "; ".join(part.rstrip(".:") for part in parts if part and not part.startswith(useless)),
    )


def _help(command: type, prog: str, arguments: Sequence[str]) -> None:
    options, hidden = with_defaults(command, arguments), set[str]()

    def is_shown(option: str) -> bool:
        group, _, rest = option.rpartition(".")
        kept = _FIRST.get(prog.removeprefix("mien "))
        common = option in kept if kept else not group or rest in _COMMON.get(group, ())
        if not common and "--help-all" not in arguments:
            hidden.add(option)
        return option not in hidden

    with contextlib.suppress(SystemExit):
        description = inspect.getdoc(command)
        tyro.cli(explained(options, is_shown), prog=prog, args=["--help"], description=description, config=_STYLE)
    if hidden:
        training = next((one for one in vars(options).values() if isinstance(one, TrainOptions)), None)
        show(f"All options: {prog}{f' --method {training.method}' if training else ''} --help-all")
    raise SystemExit(0)


def explained(
    options: Any, is_shown: Callable[[str], bool], prefix: str = "", presets: Mapping[str, Any] | None = None
) -> type:
    """A class of options whose descriptions are paragraphs, and end with the range, the default and those of presets.

    `is_shown` says whether to show an option, by its name such as "capture.size", which begins with `prefix`. `presets`
    has the same options by each preset.
    """
    kind = type(options)
    about, annotations, defaults = field_docs(kind), {}, {}
    for name, option, base, marks in _named_fields(kind, prefix):
        value, others = getattr(options, name), {each: getattr(one, name) for each, one in (presets or {}).items()}
        if tyro.conf.Fixed in marks:
            annotations[name], defaults[name] = Annotated[(base, *marks)], value
            continue
        if is_dataclass(value):
            others = value.by_preset() if isinstance(value, TrainOptions) else others
            group = explained(value, is_shown, option, others)
            annotations[name] = Annotated[(group, *marks)] if marks else group
            defaults[name] = field(default_factory=group)
            continue
        marks += [] if tyro.conf.Positional in marks or is_shown(option) else [tyro.conf.Suppress]
        listed = [mark() for mark in marks if isinstance(mark, FunctionType)]  # what is registered
        text = " ".join(" ".join([about.get(name, ""), *listed]).split())
        is_flag = base is bool and not prefix.startswith(("training", "method"))
        allowed = next((mark for mark in marks if isinstance(mark, Range)), None)
        values = partial(_about_value, is_flag or "(default:" in text, allowed, value, others)
        annotations[name] = Annotated[(base, *marks, tyro.conf.arg(help=text, help_behavior_hint=values))]
        if value is not tyro.MISSING:
            defaults[name] = value
    # It is a subclass, because tyro finds descriptions of groups in the parent.
    inside = {"__annotations__": annotations, "__doc__": kind.__doc__, "__module__": kind.__module__, **defaults}
    return dataclass(frozen=True, kw_only=True)(type(kind.__name__, (kind,), inside))


def options_of(options: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The options of a command by their names, such as "capture.size", with their defaults."""
    for name, option, _, marks in _named_fields(type(options), prefix):
        value = getattr(options, name)
        if is_dataclass(value) and tyro.conf.Fixed not in marks:
            yield from options_of(value, option)
        elif not {tyro.conf.Fixed, tyro.conf.Positional} & {*marks}:
            yield option, value


def _named_fields(kind: type, prefix: str) -> Iterator[tuple[str, str, Any, list[Any]]]:
    """The fields of a class of options: name, name of the option, type, and marks beside the type."""
    hints = get_type_hints(kind, include_extras=True)
    for one in fields(kind):
        base, *marks = get_args(hint) if get_origin(hint := hints[one.name]) is Annotated else (hint,)
        name = next((mark.name for mark in marks if getattr(mark, "name", None) is not None), None)
        option = ".".join(filter(None, (prefix, one.name.replace("_", "-") if name is None else name)))
        yield one.name, option, base, marks


def _about_value(is_silent: bool, allowed: Range | None, value: Any, others: Mapping[str, Any], default: str) -> str:
    texts = ([] if allowed is None else [str(allowed)]) + (
        [] if is_silent or default in ("None", "", "''") else [f"default: {default}"]
    )
    by_value: dict[str, list[str]] = {}
    for preset, other in others.items():
        if other != value:
            by_value.setdefault("none" if other is None else shown(other), []).append(preset)
    texts += [f"{', '.join(names)}: {text}" for text, names in by_value.items()]
    return f"({'; '.join(texts)})" if texts else ""


@cache
def field_docs(kind: type) -> Mapping[str, str]:
    """The string below each field of a dataclass, by the field's name. It is empty for classes without source code."""
    found: dict[str, str] = {}
    for base in reversed([base for base in kind.__mro__ if is_dataclass(base)]):
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        except (OSError, TypeError):
            continue
        for before, after in zip(body, body[1:], strict=False):
            if isinstance(before, ast.AnnAssign) and isinstance(after, ast.Expr):
                found[before.target.id] = after.value.value  # type: ignore[attr-defined]
    return found
