"""The options that `mien COMMAND --help` shows: the common ones. `--help-all` shows every option."""

from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

_COMMON = {
    "capture": ("size", "crop", "start", "end", "turn", "stride", "fps", "cuts", "clean_plate", "mattes"),
    "tracking": ("focal", "same_camera", "schedule"),
}
"""Common fields of each group of settings, by the prefix of the group's options."""


def without_details(command: type) -> tuple[type, list[str]]:
    """The options of a command without the rarely needed ones, and the groups that lack some of their options.

    Args:
        command: A dataclass as tyro reads it. A field that is a dataclass is a group of settings, named by the field or
            by its `tyro.conf.arg`.
    """
    shown: dict[str, Any] = {}
    groups = []
    for name, hint in get_type_hints(command, include_extras=True).items():
        parts: tuple[Any, ...] = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        kind, *marks = parts
        group = next((mark.name for mark in marks if getattr(mark, "name", None) is not None), name)
        if isinstance(kind, type) and is_dataclass(kind) and group in _COMMON:
            groups.append(group)
            settings = _hiding(kind, _COMMON[group])
            shown[name] = Annotated[(settings, *marks)] if marks else settings
    defaults = {name: field(default_factory=getattr(hint, "__origin__", hint)) for name, hint in shown.items()}
    return subclass_with(command, shown, defaults), groups


def _hiding(settings: type, kept: tuple[str, ...]) -> type:
    """The same dataclass with all fields but `kept` removed from the options."""
    import tyro

    hints = get_type_hints(settings, include_extras=True)
    hidden = {one.name: one for one in fields(settings) if one.name not in kept}
    defaults = {
        name: field(default=one.default) if one.default is not MISSING else field(default_factory=one.default_factory)
        for name, one in hidden.items()
    }
    return subclass_with(settings, {name: Annotated[hints[name], tyro.conf.Suppress] for name in hidden}, defaults)


def subclass_with(parent: type, annotations: dict[str, Any], defaults: dict[str, Any]) -> type:
    """The same dataclass with other types and defaults of some fields."""
    # It is a subclass, because tyro finds the descriptions of the fields in the parent's source.
    namespace = {"__annotations__": annotations, "__doc__": parent.__doc__, "__module__": parent.__module__, **defaults}
    return dataclass(frozen=True)(type(parent.__name__, (parent,), namespace))
