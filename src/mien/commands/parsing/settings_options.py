"""Options for every field of some settings: `density.max_gaussians` of the method is --method.density.max-gaussians.

The settings themselves (`mien.avatar.settings`) hold everything about an option: name, type, range, and a description
for the help. Options are listed under a heading for each group of settings. All learning rates of a group are under one
heading.
"""

import difflib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from mien.avatar.settings import Rate
from mien.commands.parsing.help_text import field_docs
from mien.disk.config import Range, no_such_setting, range_of, shown
from mien.errors import UserError

Settings = TypeVar("Settings")
_RATES = "Learning rates over the run: constant, or log-linear from start to end."
_AS_FIELD = "__"
"""Replaces the dot of a dotted name, because Python needs an identifier."""


@dataclass(frozen=True)
class Leaf:
    """One field that holds a value, in some settings or in nested settings."""

    name: str
    """Dotted name: `density.max_gaussians`."""
    heading: str
    """Prefix of the options that the help lists it with."""
    about_heading: str
    about: str
    kind: Any
    """Type of the field, without marks."""
    allowed: Range | None
    value: Any

    def option(self, prefix: str) -> str:
        """The option as people type it."""
        return f"--{prefix}.{self.name.replace('_', '-')}"


def leaves(settings: Any, prefix: str, names: Sequence[str] | None = None) -> list[Leaf]:
    """All fields that hold values, with their descriptions for the help.

    Args:
        settings: A dataclass with the default values.
        prefix: Start of its options: "method" for --method.NAME.
        names: Outermost fields to include (default: all).
    """
    about = (inspect.getdoc(type(settings)) or "").splitlines()[0]
    taken = [name for name in _names(settings) if names is None or name in names]
    return [leaf for name in taken for leaf in _leaves_of(settings, name, "", prefix, about)]


def _leaves_of(settings: Any, name: str, path: str, heading: str, about_heading: str) -> list[Leaf]:
    value, about = getattr(settings, name), field_docs(type(settings)).get(name, "")
    hint = get_type_hints(type(settings), include_extras=True)[name]
    if not is_dataclass(value):
        kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        return [Leaf(path + name, heading, about_heading, about, kind, range_of(hint), value)]
    inside = (f"{heading}.rates", _RATES) if isinstance(value, Rate) else (f"{heading}.{name.replace('_', '-')}", about)
    found = [leaf for one in _names(value) for leaf in _leaves_of(value, one, f"{path}{name}.", *inside)]
    if isinstance(value, Rate):
        # All rates are listed together, so the first line of each says which rate it is.
        found[0] = replace(found[0], about=f"{about} {found[0].about}")
    return found


def options_type(listed: Sequence[Leaf], prefix: str, presets: Mapping[str, Any]) -> type:
    """A dataclass that tyro turns into these options. It has a field for each heading, which has one for each leaf.

    Args:
        listed: The fields that become options.
        prefix: Start of these options.
        presets: Such settings by the name of their preset. The help shows their values where they differ.
    """
    import tyro

    # Options that belong to no group come first.
    headings: dict[str, list[tuple[str, Any, Any]]] = {prefix: [], f"{prefix}.rates": []}
    for leaf in listed:
        marks = tyro.conf.arg(
            name=leaf.option(prefix).removeprefix("--"),
            prefix_name=False,
            help=leaf.about.replace("\n", " "),
            help_behavior_hint=partial(_about_value, leaf, presets),
        )
        hint: Any = Annotated[leaf.kind, tyro.conf.FlagConversionOff, marks]
        headings.setdefault(leaf.heading, []).append((_identifier(leaf.name), hint, field(default=leaf.value)))
    about = {leaf.heading: leaf.about_heading for leaf in reversed(listed)}
    groups = []
    for heading, own in headings.items():
        if not own:
            continue
        group = make_dataclass(_identifier(heading), own, frozen=True)
        mark = tyro.conf.arg(name=heading, prefix_name=False, help=about[heading].replace("\n", " "))
        groups.append((_identifier(heading), Annotated[group, mark], field(default_factory=group)))
    return make_dataclass(f"{prefix}_options", groups, frozen=True)


def _about_value(leaf: Leaf, presets: Mapping[str, Any], default: str) -> str:
    known = ([] if leaf.allowed is None else [str(leaf.allowed)]) + (
        [] if default == "None" else [f"default: {default}"]
    )
    known += other_values(presets, leaf.name, leaf.value)
    return f"({'; '.join(known)})" if known else ""


def other_values(presets: Mapping[str, Any], name: str, value: Any) -> list[str]:
    """The values of a setting that differ from `value`, each after the names of its presets: "draft, paper: 0"."""
    found: dict[str, list[str]] = {}
    for preset, settings in presets.items():
        other = attrgetter(name)(settings)
        if other != value:
            found.setdefault("none" if other is None else shown(other), []).append(preset)
    return [f"{', '.join(names)}: {text}" for text, names in found.items()]


def apply_options(settings: Settings, options: Any) -> Settings:
    """Settings with the values of `options`, an instance of a class from `options_type`."""
    groups = [getattr(options, group.name) for group in fields(options)]
    typed = {one.name.replace(_AS_FIELD, "."): getattr(group, one.name) for group in groups for one in fields(group)}
    return _replaced(settings, typed)


def check_names(arguments: Sequence[str], prefix: str, listed: Sequence[Leaf], owner: str) -> None:
    """Check that a command line names no unknown setting."""
    known = [leaf.option(prefix) for leaf in listed]
    for argument in arguments:
        option = argument.split("=", 1)[0].replace("_", "-")
        if not option.startswith(f"--{prefix}.") or option in known:
            continue
        group = option
        while not (inside := [name for name in known if name.startswith(f"{group}.")]):
            group = group.rpartition(".")[0]
        shown = [*dict.fromkeys(_one_level(name, group) for name in inside)]
        if group == option:
            raise UserError(f"{option}: is a group of settings of {owner}; there are: {', '.join(shown)}")
        raise UserError(no_such_setting(option, owner, near_option(option, known), shown))


def near_option(option: str, known: Sequence[str]) -> list[str]:
    """The known option that was probably meant, in a list; an empty list if there is none.

    It is the one with the most similar last part, because a name may be right and its group forgotten. Without such a
    one, it is the first whose last part has the given one as one of its words.
    """
    names = [*known, *{name.rpartition(".")[0] for name in known}]
    lasts = {name: name.rpartition(".")[2] for name in names}
    near = difflib.get_close_matches(option.rpartition(".")[2], set(lasts.values()), 3)
    found = difflib.get_close_matches(option, sorted(name for name in names if lasts[name] in near), 1, 0.5)
    return found or [name for name in known if option.rpartition(".")[2] in lasts[name].split("-")][:1]


def _replaced(settings: Any, values: Mapping[str, Any]) -> Any:
    own = {name: value for name, value in values.items() if "." not in name}
    inner: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        group, dot, rest = name.partition(".")
        if dot:
            inner.setdefault(group, {})[rest] = value
    own |= {group: _replaced(getattr(settings, group), within) for group, within in inner.items()}
    return replace(settings, **own)


def _one_level(option: str, group: str) -> str:
    """An option of a group, or the nested group that it belongs to: `--method.density.*`."""
    first, dot, _ = option.removeprefix(f"{group}.").partition(".")
    return f"{group}.{first}" + (".*" if dot else "")


def _identifier(name: str) -> str:
    return name.replace("-", "_").replace(".", _AS_FIELD)


def _names(settings: Any) -> list[str]:
    return [one.name for one in fields(settings)]
