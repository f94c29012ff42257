"""The list of methods. A new method adds one line here (CONTRIBUTING.md, "Add a method").

Other packages add methods by entry points of the group `mien.methods`.

This file needs no torch, because the command line lists the methods' settings and checks them.
"""

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mien.avatar.settings import Differences, MethodConfig
from mien.errors import UserError
from mien.plugins import named, plugin, plugin_names, plugins

if TYPE_CHECKING:
    from mien.avatar.avatar import Avatar


@dataclass(frozen=True)
class Method:
    """A method: the class of its avatars, and its settings. Both are imported at their first use."""

    avatar_class: str
    """"MODULE:CLASS"; see `avatar`."""
    config_class: str
    """"MODULE:CLASS"; see `config`. A module that does not import torch keeps `--help` and the checks of options fast.
    It may hold `PRESETS`."""

    @property
    def config(self) -> type[MethodConfig]:
        """The class of the method's settings. Its defaults are the preset `standard`."""
        with _imports(self.config_class):
            return named(self.config_class)

    @property
    def presets(self) -> Mapping[str, Differences]:
        """How each preset that the method has differs from the defaults. `PRESETS` beside its settings adds to them."""
        with _imports(self.config_class):
            own = getattr(importlib.import_module(self.config_class.split(":")[0]), "PRESETS", {})
        return {"draft": {}, "standard": {}, "fine": {}, **own}

    @property
    def avatar(self) -> "type[Avatar]":
        """The class of the method's avatars. Its arguments are (config, face_model, face)."""
        with _imports(self.avatar_class):
            return named(self.avatar_class)


@contextmanager
def _imports(place: str) -> Iterator[None]:
    """Import the class at a place "MODULE:CLASS". What fails in another package is not reported as a bug in mien."""
    try:
        yield
    except (Exception, SystemExit) as error:  # whatever the code of another package raises
        if place.startswith("mien."):
            raise
        remedy = "update or uninstall the package of this method"
        raise UserError(f"{place}: cannot be imported ({error!r}); {remedy}") from error


METHODS = {
    "gaussian_avatars": Method(
        "mien.avatar.gaussian_avatars.avatar:GaussianAvatars",
        "mien.avatar.gaussian_avatars.settings:GaussianAvatarsConfig",
    ),
    "headgas": Method("mien.avatar.headgas.avatar:HeadGas", "mien.avatar.headgas.settings:HeadGasConfig"),
    "mono_gaussian_avatar": Method(
        "mien.avatar.mono_gaussian_avatar.avatar:MonoGaussianAvatar",
        "mien.avatar.mono_gaussian_avatar.settings:MonoGaussianAvatarConfig",
    ),
    "point_avatar": Method(
        "mien.avatar.point_avatar.avatar:PointAvatar", "mien.avatar.point_avatar.settings:PointAvatarConfig"
    ),
    "textured_mesh": Method(
        "mien.avatar.textured_mesh.avatar:TexturedMesh", "mien.avatar.textured_mesh.settings:TexturedMeshConfig"
    ),
}
"""Mien's own methods by name. A method whose settings import torch comes last: looking for the method of a config goes
through the settings in this order."""
DEFAULT_METHOD = "gaussian_avatars"
_GROUP = "mien.methods"  # of entry points. It takes 30 ms to read, and commands that name one of mien's own do not


def method_names() -> list[str]:
    """The names of all methods: mien's own, then those that other packages add. None of these is imported."""
    return [*METHODS, *(name for name in plugin_names(_GROUP) if name not in METHODS)]


def has_method(name: str) -> bool:
    """Whether there is a method of a name. Other packages are asked only if it is none of mien's own."""
    return name in METHODS or name in plugin_names(_GROUP)


def method_named(name: str) -> Method:
    """The method of a name. Other packages are asked only if it is none of mien's own."""
    method = METHODS.get(name) or plugin(_GROUP, name, Method)
    if method is None:
        names = ", ".join(method_names())
        raise UserError(f"no method {name!r}; give one of {names}, or install the package that adds it")
    return method


def method_of(config: MethodConfig) -> str:
    """The name of the method that a config belongs to."""
    return next(name for name, method in _all_methods() if _is_of(method, config))


def _is_of(method: Method, config: MethodConfig) -> bool:
    try:
        return method.config is type(config)
    except UserError:
        return False


def _all_methods() -> Iterator[tuple[str, Method]]:
    """Yield mien's own methods, then those of other packages, which are imported only if the loop comes to them."""
    yield from METHODS.items()
    yield from plugins(_GROUP, Method).items()
