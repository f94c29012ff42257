"""What `mien COMMAND --help` shows: the common options, with their descriptions. `--help-all` shows every option."""

import ast
import inspect
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache, partial
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

_COMMON = {
    "capture": ("size", "crop", "start", "end", "turn", "stride", "fps", "cuts", "clean_plate", "mattes"),
    "tracking": ("focal", "same_camera", "schedule"),
    "alignment": ("when",),
    "scoring": (),
}
"""Common fields of each group of settings, by the prefix of the group's options."""
_FIRST = {"create": ("out", "name", "preset", "method", "device", "view")}
"""Commands for newcomers: the only options that their help shows, so that it can be read at a glance."""


@dataclass(frozen=True)
class Described:
    """Mark of an option whose description is made when help is shown, because it lists what is registered."""

    text: Callable[[], str]


@dataclass(frozen=True)
class OtherValues:
    """A mark beside an option: the values that presets give it, such as "paper: white", for the help."""

    texts: tuple[str, ...]


def at_a_glance(command: type, name: str) -> type | None:
    """The few options of a command that newcomers need, or None if its help is short anyway. The others stay hidden."""
    kept = _FIRST.get(name)
    return None if kept is None else _only(command, kept)


def without_details(command: type) -> tuple[type, list[str]]:
    """The options of a command without the rarely needed ones, and the groups that lack some of their options.

    Args:
        command: A dataclass as tyro reads it. A field that is a dataclass is a group of settings, named by the field or
            by its `tyro.conf.arg`.
    """
    shown: dict[str, Any] = {}
    groups = []
    for name, hint in get_type_hints(command, include_extras=True).items():
        kind, *marks = _unwrapped(hint)
        group = next((mark.name for mark in marks if getattr(mark, "name", None) is not None), name)
        if isinstance(kind, type) and is_dataclass(kind) and group in _COMMON:
            groups.append(group)
            settings = _hiding(kind, _COMMON[group])
            shown[name] = Annotated[(settings, *marks)] if marks else settings
    defaults = {name: field(default_factory=getattr(hint, "__origin__", hint)) for name, hint in shown.items()}
    return subclass_with(command, shown, defaults), groups


def _only(options: type, kept: tuple[str, ...]) -> type:
    """The same options without any but `kept`, also in groups, and without hiding positional arguments."""
    import tyro

    changed: dict[str, Any] = {}
    defaults: dict[str, Any] = {}
    hints = get_type_hints(options, include_extras=True)
    for one in fields(options):
        kind, *marks = _unwrapped(hints[one.name])
        if isinstance(kind, type) and is_dataclass(kind):
            part = _only(kind, kept if any(getattr(mark, "name", None) == "" for mark in marks) else ())
            changed[one.name] = Annotated[(part, *marks)] if marks else part
            defaults[one.name] = field(default_factory=part)
        elif one.name not in kept and tyro.conf.Positional not in marks:
            changed[one.name] = Annotated[hints[one.name], tyro.conf.Suppress]
            defaults[one.name] = _default_of(one)
    return subclass_with(options, changed, defaults)


def _hiding(settings: type, kept: tuple[str, ...]) -> type:
    """The same dataclass with all fields but `kept` removed from the options."""
    import tyro

    hints = get_type_hints(settings, include_extras=True)
    hidden = {one.name: one for one in fields(settings) if one.name not in kept}
    defaults = {name: _default_of(one) for name, one in hidden.items()}
    return subclass_with(settings, {name: Annotated[hints[name], tyro.conf.Suppress] for name in hidden}, defaults)


def readable(options: Any) -> Any:
    """The same options, with descriptions that are wrapped as a whole, and without defaults that say nothing.

    A default says nothing if it is None or empty, if it is that of a flag, or if the description names the default.
    """
    import tyro

    hints = get_type_hints(options, include_extras=True)
    about = dict(field_docs(options)) | {
        name: mark.text() for name, hint in hints.items() for mark in _unwrapped(hint) if isinstance(mark, Described)
    }
    changed: dict[str, Any] = {}
    defaults: dict[str, Any] = {}
    for one in fields(options):
        kind, *marks = _unwrapped(hints[one.name])
        if isinstance(kind, type) and is_dataclass(kind):
            group = readable(kind)
            changed[one.name] = Annotated[(group, *marks)] if marks else group
            defaults[one.name] = field(default_factory=group)
        elif get_origin(kind) in (Union, types.UnionType) and all(map(is_dataclass, map(_bare, get_args(kind)))):
            commands = [Annotated[(readable(_bare(hint)), *_unwrapped(hint)[1:])] for hint in get_args(kind)]
            changed[one.name] = Annotated[(Union[tuple(commands)], *marks)]  # noqa: UP007 (their number varies)
        elif one.name in about:
            text = " ".join(about[one.name].split())
            is_silent = kind is bool or "(default:" in text
            others = [text for mark in marks if isinstance(mark, OtherValues) for text in mark.texts]
            shown = tyro.conf.arg(help=text, help_behavior_hint=partial(_about_value, is_silent, others))
            changed[one.name] = Annotated[(kind, *marks, shown)]
            if one.default is not MISSING or one.default_factory is not MISSING:
                defaults[one.name] = _default_of(one)
    return subclass_with(options, changed, defaults)


@cache
def field_docs(kind: type) -> Mapping[str, str]:
    """The string below each field of a dataclass, by the field's name. It is empty for classes without source code."""
    found: dict[str, str] = {}
    for base in reversed([base for base in kind.__mro__ if is_dataclass(base)]):
        try:
            source = inspect.getsource(base)
        except (OSError, TypeError):
            continue
        body = ast.parse(textwrap.dedent(source)).body[0]
        assert isinstance(body, ast.ClassDef)
        for before, after in zip(body.body, body.body[1:], strict=False):
            if not isinstance(before, ast.AnnAssign) or not isinstance(before.target, ast.Name):
                continue
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                found[before.target.id] = inspect.cleandoc(str(after.value.value))
    return found


def _about_value(is_silent: bool, others: Sequence[str], default: str) -> str:
    known = [] if is_silent or default in ("None", "") else [f"default: {default}"]
    return f"({'; '.join([*known, *others])})" if known or others else ""


def _unwrapped(hint: Any) -> tuple[Any, ...]:
    """A type, followed by its marks."""
    return get_args(hint) if get_origin(hint) is Annotated else (hint,)


def _bare(hint: Any) -> Any:
    return _unwrapped(hint)[0]


def _default_of(one: Any) -> Any:
    """A new field with the default of another one."""
    return field(default=one.default) if one.default is not MISSING else field(default_factory=one.default_factory)


def subclass_with(parent: type, annotations: dict[str, Any], defaults: dict[str, Any]) -> type:
    """The same dataclass with other types and defaults of some fields."""
    # It is a subclass, because tyro finds the descriptions of the fields in the parent's source.
    namespace = {"__annotations__": annotations, "__doc__": parent.__doc__, "__module__": parent.__module__, **defaults}
    return dataclass(frozen=True)(type(parent.__name__, (parent,), namespace))


def list_options(options: type) -> set[str]:
    """The options of a command that take several values, as they are written: --hold-out."""
    found: set[str] = set()
    for name, hint in get_type_hints(options, include_extras=True).items():
        base, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        given = [mark.name for mark in marks if getattr(mark, "name", None) is not None]
        if isinstance(base, type) and is_dataclass(base) and given == [""]:
            found |= list_options(base)
        elif get_origin(base) is tuple:
            found.add("--" + (given[0] if given else name.replace("_", "-")))
    return found
